"""The page on architecture shows the layers that the checker holds the code to."""

import re
import tomllib

import pytest
from helpers import ROOT


def rows_of_page(column: int) -> list[set[str]]:
    """Names in a column of the table of layers, row by row."""
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    table = page.partition("| `geoscene` | `lidar` |\n")[2]
    lines = table.partition("\n\n")[0].splitlines()[1:]
    return [names for line in lines if (names := set(re.findall(r"`(\w+)`", line.split("|")[column])))]


@pytest.mark.parametrize(("package", "column"), [("geoscene", 1), ("lidar", 2)])
def test_the_table_of_layers_is_that_of_the_checker(package, column):
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = (contract["layers"] for contract in contracts if contract.get("containers") == [package])
    assert rows_of_page(column) == [set(re.split(" [|:] ", row)) for row in layers]
