"""Random damage to files of any kind: to bytes and words, and to values behind valid syntax and checksums."""

from __future__ import annotations

import copy
import gzip
import io
import itertools
import json
import random
import re
import sqlite3
import struct
import xml.etree.ElementTree as ET
import zipfile
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

NUMBERS = (
    *(
        "nan",
        "inf",
        "-inf",
        "0",
        "-0",
        "-1",
        "1",
        "2",
        "1e308",
        "-1e308",
        "1e-308",
        "1e9",
        "1e99999999",
        "-1e9",
        "0.1",
        "1e-9",
    ),
    *("99999999999999999999", "2147483648", "-2147483649", "65536", "180", "-180", "90.0000001", "360"),
)
WORDS = (
    *NUMBERS,
    *("yes", "no", ";", ";;", ":", "null", "None", "[]", "{}", "", " ", "é", "\ufffd", "🏠", "\x01", "1;2"),
    *("1,5", "1'", "10ft", "--", "a=b", "true", "Infinity", "random", "../x", "/", ".", "x" * 300),
    *(
        "<",
        "&",
        '"',
        "\n",
        "%s",
        "\x00",
        "../../../outside",
        "/outside",
        "a/../../../outside",
        "~",
    ),
    *("[" * 3000, "{" * 3000, "9" * 5000),
)

TAGS = {
    "building": ("yes", "house", "church", "roof", "no", "train_station", "greenhouse"),
    "building:part": ("yes", "no", "roof", "steps"),
    "building:levels": ("0", "1", "2.5", "7", "1000000", "-3"),
    "building:min_level": ("0", "1", "3", "-2"),
    "building:colour": ("red", "#ca0000", "#12", "nocolour"),
    "building:material": ("brick", "glass", "unobtainium"),
    "height": ("3", "12 m", "30'", "0.001", "9999", "12,5"),
    "min_height": ("0", "3", "11.99", "-1000"),
    "roof:shape": ("flat", "gabled", "hipped", "pyramidal", "skillion", "dome", "onion", "mansard", "round",
                   "gambrel", "half-hipped", "saltbox", "cone", "many", ";gabled"),
    "roof:height": ("0", "2", "40"),
    "roof:levels": ("1", "3"),
    "roof:angle": ("0", "30", "89.9"),
    "roof:direction": ("N", "135", "SSW", "-400"),
    "roof:orientation": ("along", "across"),
    "highway": ("residential", "motorway", "footway", "steps", "pedestrian", "traffic_signals", "crossing",
                "street_lamp", "stop", "give_way", "service", "cycleway", "construction", "mini_roundabout"),
    "lanes": ("1", "2", "3", "1.5", "40", "0"),
    "lanes:forward": ("1", "0", "7"),
    "lanes:backward": ("1", "0", "7"),
    "oneway": ("yes", "-1", "reversible", "alternating"),
    "width": ("2", "40", "0.01", "3 m"),
    "maxspeed": ("5", "50", "30 mph", "walk", "none", "0"),
    "layer": ("-1", "1", "5", "-20"),
    "bridge": ("yes", "viaduct"),
    "tunnel": ("yes", "culvert", "building_passage"),
    "junction": ("roundabout", "circular"),
    "turn:lanes": ("left|through", "|||", "left;through|right"),
    "sidewalk": ("both", "left", "no", "separate"),
    "surface": ("asphalt", "gravel"),
    "incline": ("up", "10%", "-90 %"),
    "embankment": ("yes",),
    "cutting": ("yes",),
    "natural": ("tree", "tree_row", "wood", "water", "coastline", "cliff"),
    "landuse": ("forest", "grass", "residential"),
    "leaf_type": ("needleleaved", "broadleaved"),
    "diameter_crown": ("0", "5", "500"),
    "circumference": ("1", "100"),
    "barrier": ("wall", "fence", "hedge", "retaining_wall", "bollard"),
    "waterway": ("river", "stream", "riverbank"),
    "railway": ("rail", "tram", "platform"),
    "amenity": ("parking", "bench"),
    "parking:both": ("lane", "street_side"),
    "power": ("tower", "line", "pole"),
    "type": ("multipolygon", "building", "restriction"),
    "direction": ("forward", "backward", "90"),
    "restriction": ("no_left_turn", "only_straight_on"),
    "location": ("underground",),
    "indoor": ("yes",),
    "area": ("yes",),
}  # fmt: skip
"""OpenStreetMap tags that the program reads, with values that occur, rare ones among them."""


def mutate(path: Path, rng: random.Random) -> None:
    """Damage a file: one to four changes, half of them to its structure where this is known.

    One in a hundred is a link or a folder instead, or is missing.
    """
    if rng.random() < 0.01:
        _replace(path, rng)
        return
    data = path.read_bytes()
    suffix = path.suffix.lower()
    if suffix == ".gz":
        whole = gzip.decompress(data)
        inner = _damaged(whole, Path(path.stem).suffix, rng)
        if rng.random() < 0.02:
            inner += bytes(2**28)  # 256 MiB in 1 MiB
        path.write_bytes(gzip.compress(inner, 1) if rng.random() < 0.8 else _of_bytes(data, rng))
    else:
        path.write_bytes(_damaged(data, suffix, rng))


def _replace(path: Path, rng: random.Random) -> None:
    """Put something else at the place of a file, or nothing."""
    path.unlink()
    kind = rng.randrange(5)
    if kind == 0:
        path.mkdir()
    elif kind < 4:
        path.symlink_to((path, path.parent, path.with_name("absent"))[kind - 1])


def _damaged(data: bytes, suffix: str, rng: random.Random) -> bytes:
    structured = _STRUCTURED.get(suffix)
    if structured is not None and rng.random() < 0.7:
        with suppress(Exception):  # such as a file that is empty; it is damaged as bytes
            return structured(data, rng)
    for _ in range(rng.randint(1, 4)):
        try:
            text = data.decode()
        except UnicodeDecodeError:
            text = ""
        if text and rng.random() < 0.8:
            data = _of_text(text, rng).encode(errors="replace")
        else:
            data = _of_bytes(data, rng)
    return data


def _of_text(text: str, rng: random.Random) -> str:
    lines = text.split("\n")
    kind, k = rng.randrange(6), rng.randrange(len(lines))
    if kind == 0:
        del lines[k]
    elif kind == 1:
        lines.insert(rng.randrange(len(lines)), lines[k])
    else:  # replace a word between delimiters
        line = lines[k]
        cuts = [n for n, letter in enumerate(line) if letter in "\"' ,:;=<>[](){}|"] or [0]
        start = rng.choice(cuts) + 1
        stop = min((cut for cut in cuts if cut >= start), default=len(line))
        lines[k] = line[:start] + _value(line[start:stop], rng) + line[stop:]
    return "\n".join(lines)


def _of_bytes(data: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(data) + 1), rng.randint(1, 64)
    if rng.random() < 0.3:
        at = min(at, rng.randrange(1024))  # headers
    kind = rng.randrange(11)
    if kind == 7:
        return data.decode("latin-1").encode(rng.choice(("utf-16", "utf-8-sig", "cp037")), "replace")
    if kind > 7:  # a number of a header
        number = rng.choice((-1, 0, 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)) % 2**64
        number = struct.pack("<Q", number)[: rng.choice((2, 4, 8))]
        return data[:at] + number + data[at + len(number) :]
    return (
        data[:at],
        data[:at] + rng.randbytes(size) + data[at:],
        data[:at] + rng.randbytes(size) + data[at + size :],
        data[:at] + bytes(size) + data[at + size :],
        data[:at] + b"\xff" * size + data[at + size :],
        data[:at] + data[at + size :],
        data[:at] + bytes([data[at - 1] ^ 1 << rng.randrange(8)] if at else []) + data[at + 1 :],
    )[kind]


def _value(old: str, rng: random.Random) -> str:
    """Another value: a word, or a number near or far from the old one."""
    if rng.random() < 0.4:
        with suppress(ValueError, OverflowError):
            number = float(old)
            other = rng.choice(
                (-number, number * 10 ** rng.uniform(-6, 6), number + rng.gauss(0, 1e-4), number + 1)
            )
            return repr(int(other)) if re.fullmatch(r"-?\d+", old) else repr(other)
    return rng.choice(WORDS)


def _of_xml(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.02:
        return _with_entities(data)
    root = ET.fromstring(data)  # noqa: S314 - of the benchmark's own file
    parents = {child: parent for parent in root.iter() for child in parent}
    for _ in range(rng.randint(1, 4)):
        element = rng.choice(list(parents) or [root])
        parent = parents.get(element, root)
        kind = rng.randrange(8)
        if kind == 0 and element in parent:
            parent.remove(element)
        elif kind == 1:
            rng.choice([parent, *parents]).append(copy.deepcopy(element))
        elif kind == 2 and len(parent) > 1:
            children = list(parent)
            rng.shuffle(children)
            parent[:] = children
        elif kind == 3 and element.text and element.text.strip():
            element.text = _value(element.text, rng)
        elif kind == 4 and "lat" in element.attrib:
            step = 10 ** rng.uniform(-9, 0)
            for name in ("lat", "lon"):
                with suppress(ValueError):
                    element.set(name, repr(float(element.get(name, "0")) + rng.gauss(0, step)))
        elif kind == 5 and root.tag == "osm":
            target = rng.choice([e for e in root if e.tag != "bounds"] or [root])
            key = rng.choice(list(TAGS))
            for tag in [t for t in target.findall("tag") if t.get("k") == key]:
                target.remove(tag)
            ET.SubElement(target, "tag", k=key, v=rng.choice(TAGS[key] if rng.random() < 0.8 else WORDS))
        elif kind == 6 and element.tag in ("nd", "member"):
            others = [e.get("ref", "") for e in root.iter(element.tag)]
            element.set("ref", rng.choice(others))
        elif element.attrib:
            name = rng.choice(list(element.attrib))
            if rng.random() < 0.1:
                del element.attrib[name]
            else:
                element.set(name, _value(element.attrib[name], rng))
    return ET.tostring(root)


def _with_entities(data: bytes) -> bytes:
    """The document with entities that expand to 10^9 letters, the last of them in an attribute and a text."""
    names = "abcdefghij"
    rows = [f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in itertools.pairwise(names)]
    kinds = f'<!DOCTYPE x [<!ENTITY a "x">{"".join(rows)}]>'
    start, _, rest = data.decode().rpartition("?>")
    tag, end, more = rest.partition(">")
    text = f'{start}{"?>" * bool(start)}{kinds}{tag}{end}<tag k="&j;" v="1">&j;</tag>{more}'
    return text.encode()


def _of_json(data: bytes, rng: random.Random) -> bytes:
    document = json.loads(data)
    for _ in range(rng.randint(1, 3)):
        document = _other_json(document, rng)
    if isinstance(document, dict):
        document.pop("digest", None)  # the checksum of a scene's manifest
    return json.dumps(document).encode()


def _other_json(value: Any, rng: random.Random) -> Any:
    """A JSON document with another value at a random place."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        kind = rng.random()
        if kind < 0.1:
            return {k: v for k, v in value.items() if k != key}
        if kind < 0.15:
            return value | {rng.choice(list(value)): value[key]}
        if kind < 0.2:
            other = rng.choice(("../outside", "../../outside", "/outside", "a/b", "..", "", ".", "x" * 300))
            return {other if k == key else k: v for k, v in value.items()}
        return value | {key: _other_json(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at, kind = rng.randrange(len(value)), rng.random()
        if kind < 0.1:
            return value[:at] + value[at + 1 :]
        if kind < 0.2:
            return [*value[:at], *[value[at]] * rng.randint(1, 3), *value[at:]]
        return [*value[:at], _other_json(value[at], rng), *value[at + 1 :]]
    if isinstance(value, (int, float)) and not isinstance(value, bool) and rng.random() < 0.5:
        return rng.choice((0, -1, 1, -value, value + 1, value * 1e6, 1e308, 2**31, 2**63, float("nan"), 0.5))
    return rng.choice(
        (None, True, 0, -1, 1.5, "", "x", [], {}, [[]], [None], {"a": 1}, _value(str(value), rng))
    )


def _of_arrays(data: bytes, rng: random.Random) -> bytes:
    """Another value, type or shape of a member of an .npz file."""
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    if rng.random() < 0.1:
        return _of_many_numbers(arrays, rng)
    for _ in range(rng.randint(1, 2)):
        name = rng.choice(list(arrays))
        array, kind = arrays[name], rng.randrange(7)
        if kind == 0:
            del arrays[name]
            break
        if kind == 1:
            array = array[: rng.randrange(len(array) + 1)] if array.ndim else array
        elif kind == 2:
            array = array.astype(rng.choice(("f4", "f8", "i4", "u1", "i8", "?", "U3")))
        elif kind == 3:
            array = array.ravel() if array.ndim != 1 else array[:, None]
        elif kind == 4:
            array = np.concatenate([array, array]) if array.ndim else array
        elif array.size and array.dtype.kind in "iufb":
            flat = array.ravel().copy()
            ends = [0, 1] if array.dtype.kind == "b" else [0, *_ends(array.dtype)]
            flat[rng.randrange(flat.size)] = rng.choice(ends)
            array = flat.reshape(array.shape)
        arrays[name] = array
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=array.dtype == object)
            file.writestr(f"{name}.npy", buffer.getvalue())
    return out.getvalue()


def _of_many_numbers(arrays: dict[str, Any], rng: random.Random) -> bytes:
    """An .npz file with a member that holds, or only states that it holds, far more numbers."""
    out, victim = io.BytesIO(), rng.choice(list(arrays))
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=False)
            member = buffer.getvalue()
            if name == victim and rng.random() < 0.5:
                member = re.sub(
                    rb"'shape': \((\d*)", rb"'shape': (%d" % rng.choice((10**9, 10**12, 10**18)), member
                )
            elif name == victim:
                buffer = io.BytesIO()
                np.save(buffer, np.zeros((2**25, *array.shape[1:]), array.dtype)[: 2**28], allow_pickle=False)
                member = buffer.getvalue()[: 2**28]
            file.writestr(f"{name}.npy", member)
    return out.getvalue()


def _ends(dtype: np.dtype[Any]) -> list[float]:
    if dtype.kind == "f":
        return [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30]
    limits = np.iinfo(dtype)
    return [limits.min, limits.max, 1, min(limits.max, 1000)]


def _of_database(data: bytes, rng: random.Random) -> bytes:
    """Another value in a table of an SQLite file, or one table or row less."""
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        triggers = base.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
        for (name,) in triggers:
            base.execute(f'DROP TRIGGER "{name}"')
        names = [row[0] for row in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        table = rng.choice([name for name in names if not name.startswith(("rtree_", "sqlite_"))])
        columns = [row[1] for row in base.execute(f'PRAGMA table_info("{table}")')]
        column, kind = rng.choice(columns), rng.randrange(8)
        if kind == 0:
            base.execute(f'DROP TABLE "{table}"')
        elif kind == 1 and len(columns) > 1:
            base.execute(f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "x{column}"')
        else:
            row, old = rng.choice(base.execute(f'SELECT rowid, "{column}" FROM "{table}"').fetchall())  # noqa: S608
            if kind == 2:
                base.execute(f'DELETE FROM "{table}" WHERE rowid = ?', (row,))  # noqa: S608
            else:
                others = (None, 0, -1, 1e308, 2**40, _value(str(old), rng))
                new = _of_bytes(old, rng) if isinstance(old, bytes) else rng.choice(others)
                words = f'UPDATE OR IGNORE "{table}" SET "{column}" = ? WHERE rowid = ?'  # noqa: S608
                base.execute(words, (new, row))
        base.commit()
        return base.serialize()


def _of_toml(data: bytes, rng: random.Random) -> bytes:
    """Another value of a key, mostly of valid syntax, or one key less, more or of another name."""
    lines = data.decode().split("\n")
    keys = [k for k, line in enumerate(lines) if re.match(r"\w+ *= *[^\[]*(\[.*\])?$", line)]
    for _ in range(rng.randint(1, 3)):
        k = rng.choice(keys)
        name, _, old = lines[k].partition("=")
        kind = rng.randrange(10)
        if kind == 0:
            lines[k] = ""
        elif kind == 1:
            lines.insert(rng.choice(keys), lines[k])
        elif kind == 2:
            lines[k] = f"{name.strip()}x ={old}"
        elif kind == 3:
            lines[k] = f"{name}= {lines[rng.choice(keys)].partition('=')[2]}"
        elif numbers := list(re.finditer(r"-?[\d.]+(e-?\d+)?", old)):
            at = rng.choice(numbers)
            lines[k] = f"{name}={old[: at.start()]}{_number(at.group(), rng)}{old[at.end() :]}"
        else:
            lines[k] = f"{name}= {rng.choice(_TOML_VALUES)}"
    return "\n".join(lines).encode()


def _number(old: str, rng: random.Random) -> str:
    text = _value(old, rng)
    try:
        float(text)
    except ValueError:
        return rng.choice(_TOML_VALUES)
    return text


_TOML_VALUES = (
    *("0", "-1", "1", "1.5", "1e9", "1e308", "nan", "inf", "-inf", "9223372036854775807", "true", "[]", "{}"),
    *('""', '"x"', '"../a"', "[[]]", "[1, 2]", "['a']", "1979-05-27", "[1e308, 1e308, 1e308]", "[nan, 0, 0]"),
)


def _of_rows(data: bytes, rng: random.Random) -> bytes:
    """Another cell of a CSV file, or one less, or one row twice or in another place."""
    rows = [line.split(",") for line in data.decode().splitlines()]
    for _ in range(rng.randint(1, 3)):
        k = rng.randrange(len(rows))
        column, kind = rng.randrange(len(rows[k])), rng.randrange(8)
        if kind == 0:
            rows.append(rows.pop(k))
        elif kind == 1:
            rows.insert(k, rows[k])
        elif kind == 2:
            del rows[k][column]
        elif kind == 3:
            rows = [row[:column] + row[column + 1 :] for row in rows]
        else:
            rows[k] = [*rows[k][:column], _value(rows[k][column], rng), *rows[k][column + 1 :]]
        if not rows[-1] or len(rows) < 2:
            break
    return "\n".join(",".join(row) for row in rows).encode() + b"\n"


_STRUCTURED = {
    **dict.fromkeys((".osm", ".graphml", ".gpx", ".xml"), _of_xml),
    **dict.fromkeys((".json", ".geojson"), _of_json),
    ".npz": _of_arrays,
    ".gpkg": _of_database,
    ".csv": _of_rows,
    ".toml": _of_toml,
}
