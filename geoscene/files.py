"""Files that appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def write_atomically(path: Path, data: bytes) -> None:
    """Write ``data`` beside ``path`` and move it there whole."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document as indented UTF-8 JSON."""
    write_atomically(path, (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode("utf-8"))


def write_columns(path: Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> None:
    """Write columns as CSV with a header; floats in the shortest text that reads back the same."""
    lists = [np.asarray(c).tolist() for c in columns.values()]
    lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*lists, strict=True))]
    write_atomically(path, ("\n".join(lines) + "\n").encode("utf-8"))
