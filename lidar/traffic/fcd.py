"""Traffic recorded by SUMO: floating car data (``--fcd-output``), the network it belongs to, its types.

See "FCD Output", "Vehicle Type Parameter Defaults" and "Geo-Coordinates" in SUMO's documentation.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.support.untrusted import TooLargeError, open_unpacked
from geoscene.typing import Float
from lidar.errors import FormatError

if TYPE_CHECKING:
    from pyproj import Transformer

_HEAD = 1 << 16  # bytes at a file's start that hold SUMO's options
_OPTION = re.compile(
    r'<(net-file|route-files|additional-files|fcd-output\.geo|fcd-output\.utm) value="([^"]*)"'
)
_UNDONE = ("", "!", "-", ".")  # values of projParameter without an inverse

_LENGTHS = {
    "passenger": 5.0,
    "taxi": 5.0,
    "emergency": 6.5,
    "delivery": 6.5,
    "truck": 7.1,
    "trailer": 16.5,
    "bus": 12.0,
    "coach": 14.0,
    "motorcycle": 2.2,
    "moped": 2.1,
    "bicycle": 1.6,
    "pedestrian": 0.215,
}
"""Default length in metres of SUMO's vehicle classes."""

_WORDS = (
    *(("trailer", "trailer"), ("truck", "truck"), ("lorry", "truck"), ("hgv", "truck"), ("coach", "coach")),
    *(("tram", ""), ("rail", ""), ("train", ""), ("subway", ""), ("ship", ""), ("container", "")),
    *(("motorcycle", "motorcycle"), ("motorbike", "motorcycle"), ("moped", "moped"), ("scooter", "moped")),
    *(("bicycle", "bicycle"), ("bike", "bicycle"), ("cyclist", "bicycle"), ("ped", "pedestrian")),
    *(("person", "pedestrian"), ("delivery", "delivery"), ("van", "delivery"), ("emergency", "emergency")),
    *(("taxi", "taxi"), ("bus", "bus")),
)
"""Words in the names of types, first match first, and their classes; "" for those left out."""
_OTHER = {"private": "passenger", "evehicle": "passenger", "hov": "passenger", "vip": "passenger",
          "army": "truck", "authority": "passenger", "wheelchair": "pedestrian"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Fcd:
    """Floating car data, one row per vehicle or person and time step, sorted by vehicle and time.

    name     : (n,) its id, ``first`` (n + 1,) its rows
    vclass   : (n,) its class: a key of `length_of`
    length   : (n,) metres
    time     : (k,) seconds
    lon, lat : (k,) degrees, WGS 84, middle of the front bumper
    ahead    : (k, 2) longitude and latitude of a point about a metre ahead of it
    speed    : (k,) m/s, NaN where the file has none
    """

    name: tuple[str, ...]
    first: NDArray[np.int64]
    vclass: tuple[str, ...]
    length: Float
    time: Float
    lon: Float
    lat: Float
    ahead: Float
    speed: Float


def read_fcd(path: Path, *, net: Path | None = None) -> Fcd:
    """The vehicles and persons of a file, without rail vehicles and ships.

    Raises FormatError for a file that is missing, damaged or no floating car data, and if the position of
    its network on Earth is unknown.
    """
    sumo_options = _sumo_options(path)
    rows, names, kinds = _rows(path)
    if not len(rows):
        raise FormatError(f"{path}: no vehicles and no persons in it; write it with sumo --fcd-output")
    number, time, x, y, angle, speed = rows.T
    geo = sumo_options.get("fcd-output.geo") == "true"
    net = net or _linked_file(path, sumo_options.get("net-file", ""))
    if not geo and net is None and (np.abs(x) <= 180).all() and (np.abs(y) <= 90).all():
        geo = True
    c, s = np.sin(np.radians(angle)), np.cos(np.radians(angle))  # east and north from degrees clockwise
    if geo:
        metre = 1 / 111_320.0
        lon, lat = x, y
        ahead = np.column_stack([lon + metre * c / np.cos(np.radians(lat)), lat + metre * s])
    elif net is None:
        raise FormatError(
            f"{path}: x and y are coordinates of a network that was not found; add net=FILE.net.xml, or run"
            " sumo with --fcd-output.geo"
        )
    else:
        projection = network_projection(net)
        if sumo_options.get("fcd-output.utm") == "true":
            projection = replace(projection, offset=np.zeros(2))
        at = np.column_stack([x, y])
        lon, lat = projection.to_geographic(at)
        ahead = np.column_stack(projection.to_geographic(at + np.column_stack([c, s])))
    known = _types(path, sumo_options)
    classes = [known.get(kind, ("", None)) for kind in kinds]
    vclass = [given or _class_of(kind) for (given, _), kind in zip(classes, kinds, strict=True)]
    length = [
        metres if metres is not None else _LENGTHS.get(c, 5.0)
        for (_, metres), c in zip(classes, vclass, strict=True)
    ]
    order = np.lexsort((time, number))
    order = order[np.isin(number[order], [k for k, c in enumerate(vclass) if c in _LENGTHS])]
    used, counts = np.unique(number[order].astype(int), return_counts=True)
    return Fcd(
        tuple(names[k] for k in used),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        tuple(vclass[k] for k in used),
        np.array([length[k] for k in used], float),
        time[order],
        lon[order],
        lat[order],
        ahead[order],
        speed[order],
    )


def _class_of(kind: str) -> str:
    """SUMO's class of a type by its name; "" for classes that are left out."""
    name = kind.lower()
    return next((c for word, c in _WORDS if word in name), "passenger")


@contextmanager
def _open_file(path: Path) -> Iterator[IO[bytes]]:
    """An XML file, gzipped or not; raises FormatError if it cannot be read."""
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
        with open_unpacked(path, ".gz" if packed else "") as file:
            yield file
    except FileNotFoundError:
        raise FormatError(f"{path} does not exist") from None
    except TooLargeError as error:
        raise FormatError(f"{path}: {error}") from None
    except (OSError, EOFError, zlib.error) as error:
        raise FormatError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ET.ParseError, LookupError) as error:  # also of an unknown encoding
        raise FormatError(f"{path}: broken XML ({reason_of(error)}); was sumo still writing it?") from None


def _sumo_options(path: Path) -> dict[str, str]:
    """SUMO's options in the comment at the file's start."""
    with _open_file(path) as file:
        head = file.read(_HEAD).decode("utf-8", "replace")
    head, _, _ = head.partition("<fcd-export")
    return dict(_OPTION.findall(head))


def _linked_file(path: Path, named: str) -> Path | None:
    """A file that another one names, in its folder or at the given path; None if it does not exist."""
    found = [p for p in (path.parent / named, Path(named)) if named and p.is_file()]
    return found[0] if found else None


def _elements(file: IO[bytes], tag: str) -> Iterator[ET.Element]:
    """The root, then the elements of a tag; each is released when the next is read."""
    events = ET.iterparse(file, events=("start", "end"))  # noqa: S314  (expat bounds what entities expand to)
    _, root = next(events)
    yield root
    depth = 1
    for event, element in events:
        depth += 1 if event == "start" else -1
        if event == "end" and element.tag == tag:
            yield element
        if event == "end" and depth == 1:
            root.clear()


def _rows(path: Path) -> tuple[Float, list[str], list[str]]:
    """Rows (k, 6) of number, time, x, y, angle and speed; ids and types by number."""
    rows: list[tuple[float, ...]] = []
    numbers: dict[tuple[str, str], int] = {}
    kinds: list[str] = []
    with _open_file(path) as file:
        steps = _elements(file, "timestep")
        root = next(steps)
        if root.tag != "fcd-export":
            raise FormatError(f"{path}: <{root.tag}> is not floating car data; run sumo with --fcd-output")
        for step in steps:
            time = _number(path, step, attribute="time", where="a time step")
            for mover in step:
                if mover.tag not in ("vehicle", "person"):
                    continue
                name = mover.get("id", "")
                where = f"{mover.tag} {name!r} at {time:g} s"
                key = (mover.tag, name)
                if key not in numbers:
                    numbers[key] = len(numbers)
                    kinds.append(mover.get("type", "") if mover.tag == "vehicle" else "pedestrian")
                x, y, angle = (_number(path, mover, attribute=a, where=where) for a in ("x", "y", "angle"))
                speed = np.nan
                if "speed" in mover.attrib:
                    speed = _number(path, mover, attribute="speed", where=where)
                rows.append((numbers[key], time, x, y, angle, speed))
    return np.array(rows, float).reshape(-1, 6), [name for _, name in numbers], kinds


def _number(path: Path, element: ET.Element, *, attribute: str, where: str) -> float:
    text = element.get(attribute)
    try:
        value = float(text if text is not None else "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        fault = "is missing" if text is None else f"= {text!r} is no number"
        raise FormatError(f"{path}: {where}: {attribute} {fault}")
    return value


@dataclass(frozen=True, slots=True)
class NetworkProjection:
    """Coordinates of a SUMO network: projected coordinates plus an offset (2,), in metres."""

    offset: Float
    transformer: Transformer

    def to_geographic(self, xy: Float) -> tuple[Float, Float]:
        """Longitudes (n,) and latitudes (n,) in degrees, WGS 84, of points (n, 2)."""
        lon, lat = self.transformer.transform(*(xy - self.offset).T)
        return np.asarray(lon, float), np.asarray(lat, float)


def network_projection(net: Path) -> NetworkProjection:
    """The projection of a network file; raises FormatError for one without a usable projection."""
    from pyproj import CRS, Transformer  # noqa: PLC0415
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    with _open_file(net) as file:
        places = _elements(file, "location")
        root = next(places)
        place = next(places, None) if root.tag == "net" else None
    if place is None:
        raise FormatError(f"{net}: not a SUMO network with a <location>")
    proj = place.get("projParameter", "")
    try:
        shift = np.array([float(v) for v in place.get("netOffset", "").split(",")])
    except ValueError:
        shift = np.empty(0)
    if shift.shape != (2,):
        raise FormatError(f"{net}: netOffset = {place.get('netOffset')!r} is not two numbers")
    if proj in _UNDONE:
        raise FormatError(
            f"{net}: has no projection that can be undone ({proj!r}); run sumo with a network that"
            " geoscene exported or that netconvert --proj made"
        )
    try:
        return NetworkProjection(shift, Transformer.from_crs(CRS(proj), "EPSG:4326", always_xy=True))
    except CRSError as error:
        raise FormatError(f"{net}: projParameter = {proj!r}: {reason_of(error)}") from None


def _types(path: Path, sumo_options: dict[str, str]) -> dict[str, tuple[str, float | None]]:
    """Class and length of the vehicle types in the route files that exist."""
    out: dict[str, tuple[str, float | None]] = {}
    named = f"{sumo_options.get('route-files', '')},{sumo_options.get('additional-files', '')}"
    for name in named.split(","):
        source = _linked_file(path, name.strip())
        if source is None:
            continue
        with _open_file(source) as file:
            types = _elements(file, "vType")
            next(types)
            for element in types:
                vclass = element.get("vClass", "passenger")
                vclass = _OTHER.get(vclass, vclass)
                where = f"vType {element.get('id')!r}"
                length = None
                if "length" in element.attrib:
                    length = _number(source, element, attribute="length", where=where)
                out[element.get("id", "")] = vclass if vclass in _LENGTHS else "left out", length
    return out
