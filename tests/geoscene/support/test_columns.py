"""Tables as CSV."""

import numpy as np
import pytest

from geoscene.support import columns as tables
from geoscene.support.columns import write_columns


@pytest.mark.parametrize("rows", [0, 1, 100, 101])
def test_tables_are_written_in_blocks(rows, monkeypatch, tmp_path):
    columns = {"k": np.arange(rows), "x": np.arange(rows) / 7, "name": [f"a,{k}" for k in range(rows)]}
    write_columns(tmp_path / "whole.csv", columns)
    monkeypatch.setattr(tables, "BLOCK_ROWS", 10)
    write_columns(tmp_path / "parts.csv", columns)
    text = (tmp_path / "parts.csv").read_bytes()
    assert text == (tmp_path / "whole.csv").read_bytes()
    assert text.count(b"\n") == rows + 1
    assert text.startswith(b"k,x,name\n")
