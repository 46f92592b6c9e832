"""Damaged files: mutations of a text or binary file, some of bytes and some of values."""

import re

import numpy as np

_TOKENS = (
    *(
        "nan",
        "inf",
        "-1",
        "0",
        "1e308",
        "1e400",
        "-1e-320",
        "9" * 25,
        '""',
        '"x"',
        "[]",
        "{}",
        "null",
        "true",
    ),
    *("''", "[[]]", "[null]", '[""]', "[1, 2]", '{"a": 1}', "0x10", "1979-05-27", "\x00", "\u00e4", "\u2028"),
)
_VALUE = re.compile(rb"-?\d[\w.+-]*|\"[^\"\n]*\"|\[[^\[\]]*\]|true|false|null")
_CODECS = ("latin-1", "utf-16", "utf-8-sig", "utf-32", "cp037")


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The file with one to three random mutations."""
    for _ in range(int(rng.integers(1, 4))):
        data = _MUTATIONS[int(rng.integers(len(_MUTATIONS)))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    return int(rng.integers(len(data) + 1))


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _without_a_part(data: bytes, rng: np.random.Generator) -> bytes:
    a, b = sorted((_place(data, rng), _place(data, rng)))
    return data[:a] + data[min(b, a + 200) :]


def _changed_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 8)) if data else 0):
        out[int(rng.integers(len(out)))] = int(rng.integers(256))
    return bytes(out)


def _other_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.integers(len(lines), size=2)
    if rng.random() < 0.5:
        lines.insert(int(a), lines[b])
    else:
        del lines[int(a)]
    return b"\n".join(lines)


def _other_value(data: bytes, rng: np.random.Generator) -> bytes:
    found = list(_VALUE.finditer(data))
    if not found:
        return data
    at = found[int(rng.integers(len(found)))]
    if rng.random() < 0.3:
        other = found[int(rng.integers(len(found)))].group()
    else:
        other = _TOKENS[int(rng.integers(len(_TOKENS)))].encode()
    return data[: at.start()] + other + data[at.end() :]


def _other_codec(data: bytes, rng: np.random.Generator) -> bytes:
    codec = _CODECS[int(rng.integers(len(_CODECS)))]
    return data.decode("latin-1").encode(codec, "replace")


_MUTATIONS = (
    *(_cut, _without_a_part, _changed_bytes, _other_line),
    *(_other_value, _other_value, _other_value, _other_codec),
)
