"""OpenDRIVE 1.7: the road graph as reference lines, lanes, junctions, signals; and SUMO networks from it."""

from __future__ import annotations

import re
import subprocess
import warnings
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from geoscene.errors import GeosceneError, need
from geoscene.export.kinds import Summary
from geoscene.export.objects import attribution
from geoscene.export.roadnet import END, START, Carriageway, Connection, RoadNet, road_net, section_starts
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene
from geoscene.support.files import atomic_file, temporary_folder
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float

_TYPES = {
    "motorway": "motorway",
    "trunk": "townExpressway",
    "primary": "townArterial",
    "secondary": "townArterial",
    "tertiary": "townCollector",
    "unclassified": "townLocal",
    "residential": "townLocal",
    "living_street": "townPlayStreet",
    "service": "townPrivate",
}
_FAST = 70 / 3.6
"""Metres a second above which a road that is no motorway is a rural one."""

_THIN = 1e-6
"""Metres: what rounding leaves of a carriageway beside its lanes is no shoulder."""

_SIGNALS = {
    "traffic_signals": ("yes", "OpenDRIVE", "1000001"),
    "stop": ("no", "DE", "206"),
    "give_way": ("no", "DE", "205"),
}
"""Dynamic, country, type: OpenDRIVE's own code of a three-light signal, the numbers of the StVO's signs."""

_STAMP = re.compile(rb"<!--.*?-->\s*", re.DOTALL)
_VALUES = re.compile(r"'[^']*'|\b(start|end)\b|-?\d+(\.\d+)?")  # what differs between warnings of a kind


def write_opendrive(scene: Scene, path: Path, *, progress: Progress = silent) -> Summary:
    """Write the road graph as OpenDRIVE 1.7.

    Every carriageway is a road: its centre line with rounded corners (lines and arcs, within 0.1 m of the
    map's), its elevation profile, its lanes in both directions, speed limit, signals and signs, bridges
    and tunnels. Junctions have a connecting road (paramPoly3) for every permitted turn. ``userData``
    contains the id of the OpenStreetMap way. Roads that return to their junction, and those that are side
    by side with another between the same junctions, have several lane sections (`roadnet.RoadNet`). A
    lane that both directions share has the type ``bidirectional``; the rest of a wide carriageway is a
    ``shoulder`` on each side. Restrictions via ways cannot be expressed, as junctions link pairs of roads
    only; the summary counts them.

    Raises SceneFormatError for a scene without drivable roads.
    """
    return _write(scene, path, split_shared=False, progress=progress)


def _write(scene: Scene, path: Path, *, split_shared: bool, progress: Progress) -> Summary:
    """See `write_opendrive` and, for ``split_shared``, `road_net`."""
    graph = scene.road_graph()
    left_hand = scene.left_hand
    net = road_net(graph, left_hand=left_hand, split_shared=split_shared)
    controls: dict[int, list[tuple[float, str]]] = defaultdict(list)
    for edge, offset, kind in graph.controls:
        controls[edge].append((offset / max(float(graph.length[edge]), 1e-9), kind))
    first = len(net.roads) + 1
    junctions = {
        int(node): first + len(net.connections) + k for k, node in enumerate(np.flatnonzero(net.junctions))
    }
    with atomic_file(path) as out:
        out.write(_header(scene).encode())
        for k in range(len(net.roads)):
            progress("OpenDRIVE", k, total=len(net.roads))
            road = _road(graph, net, k=k, junctions=junctions, controls=controls, left_hand=left_hand)
            out.write("".join(road).encode())
        for k, connection in enumerate(net.connections):
            road = _connecting_road(
                graph, net, c=connection, number=first + k, junctions=junctions, left_hand=left_hand
            )
            out.write("".join(road).encode())
        out.write("".join(_junctions(net, junctions, first=first, left_hand=left_hand)).encode())
        out.write(b"</OpenDRIVE>\n")
    chains = len(graph.chain_edges)
    lost = (f"{chains} turn restrictions via ways are left out: OpenDRIVE has only those via nodes",)
    notes = lost if chains else ()
    return Summary.of(path, "opendrive", objects=len(net.roads), crs=scene.frame.name, notes=notes)


def _n(value: float) -> str:
    """A number with 9 decimals (nanometres), without trailing zeros."""
    text = f"{value:.9f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _header(scene: Scene) -> str:
    xmin, ymin, xmax, ymax = scene.bounds
    with warnings.catch_warnings():
        # PROJ strings are all that OpenDRIVE takes; pyproj warns of what they leave out of a CRS.
        warnings.simplefilter("ignore", UserWarning)
        proj = scene.frame.crs.to_proj4()
    east, north = scene.frame.origin
    offset = f'<offset x="{_n(east)}" y="{_n(north)}" z="0" hdg="0"/>\n' if east or north else ""
    stamps = [str(source.get("timestamp") or "") for source in scene.manifest.get("sources", [])]
    date = max([stamp.rstrip("Z") for stamp in stamps if "T" in stamp], default="2000-01-01T00:00:00")
    name = quoteattr(str(scene.manifest.get("name", "")) or "scene")
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<OpenDRIVE>\n'
        f'<header revMajor="1" revMinor="7" name={name} version="1" date="{date}" north="{_n(ymax)}" '
        f'south="{_n(ymin)}" east="{_n(xmax)}" west="{_n(xmin)}" vendor="geoscene">\n'
        f"<geoReference><![CDATA[{proj}]]></geoReference>\n{offset}"
        f'<userData code="attribution" value={quoteattr(attribution(scene))}/>\n</header>\n'
    )


def _road(
    graph: RoadGraph,
    net: RoadNet,
    *,
    k: int,
    junctions: dict[int, int],
    controls: dict[int, list[tuple[float, str]]],
    left_hand: bool,
) -> Iterator[str]:
    road = net.roads[k]
    edge, plan = road.edge, road.plan
    name = quoteattr(str(graph.name[edge] or graph.ref[edge]))
    rule = "LHT" if left_hand else "RHT"
    yield f'<road name={name} length="{_n(plan.total)}" id="{k + 1}" junction="-1" rule="{rule}">\n<link>'
    nodes = {START: int(graph.tail[edge]), END: int(graph.head[edge])}
    for end, word in ((START, "predecessor"), (END, "successor")):
        if (k, end) in net.joints:
            other, contact = net.joints[k, end]
            point = "start" if contact == START else "end"
            yield f'<{word} elementType="road" elementId="{other + 1}" contactPoint="{point}"/>'
        elif nodes[end] in junctions:
            yield f'<{word} elementType="junction" elementId="{junctions[nodes[end]]}"/>'
    speed = float(graph.speed[edge])
    yield f'</link>\n<type s="0" type="{_type(graph, edge)}">{_speed(speed)}</type>\n<planView>\n'
    for s, x, y, heading, length, curvature in zip(
        *(c.tolist() for c in (plan.s, plan.x, plan.y, plan.heading, plan.length, plan.curvature)),
        strict=True,
    ):
        shape = f'<arc curvature="{curvature:.12g}"/>' if curvature else "<line/>"
        yield _geometry(s, x, y=y, heading=heading, length=length, shape=shape)
    yield "</planView>\n<elevationProfile>\n"
    yield from _elevations(plan.at, road.line[:, 2])
    yield "</elevationProfile>\n<lateralProfile/>\n<lanes>\n"
    shift = road.shift if not left_hand else -road.shift
    yield f'<laneOffset s="0" a="{_n(shift)}" b="0" c="0" d="0"/>\n'
    sections = int(net.sections[k])
    for part, begin in enumerate(section_starts(plan, sections)):
        yield f'<laneSection s="{_n(begin)}">\n'
        yield from _lanes(graph, net, k=k, inner=(part > 0, part < sections - 1), left_hand=left_hand)
        yield "</laneSection>\n"
    yield "</lanes>\n<objects>"
    for kind, there, detail in (
        ("tunnel", graph.tunnel[edge], 'type="standard" lighting="1" daylight="0"'),
        ("bridge", graph.bridge[edge], 'type="concrete"'),
    ):
        if there:
            yield f'<{kind} id="{kind}{k + 1}" s="0" length="{_n(plan.total)}" {detail}/>'
    yield "</objects>\n<signals>"
    yield from _signals(road, k, controls=controls, left_hand=left_hand)
    yield f'</signals>\n<userData code="osm" value={quoteattr(str(graph.osm_id[edge]))}/>\n</road>\n'


def _type(graph: RoadGraph, edge: int) -> str:
    kind = _TYPES.get(str(graph.highway[edge]).removesuffix("_link"), "unknown")
    return "rural" if kind != "motorway" and graph.speed[edge] > _FAST else kind


def _speed(speed: float) -> str:
    return f'<speed max="{_n(round(speed, 4))}" unit="m/s"/>'


def _geometry(s: float, x: float, *, y: float, heading: float, length: float, shape: str) -> str:
    place = f's="{_n(s)}" x="{_n(x)}" y="{_n(y)}" hdg="{heading:.12g}" length="{_n(length)}"'
    return f"<geometry {place}>{shape}</geometry>\n"


def _elevations(at: Float, height: Float) -> Iterator[str]:
    """Constant gradients from vertex to vertex; equal ones are joined."""
    slope = np.diff(height) / np.maximum(np.diff(at), 1e-9)
    fresh = np.append(True, np.abs(np.diff(slope)) > 1e-9)
    for s, z, b in zip(at[:-1][fresh], height[:-1][fresh], slope[fresh], strict=True):
        yield f'<elevation s="{_n(s)}" a="{_n(z)}" b="{_n(b)}" c="0" d="0"/>\n'


def _lanes(
    graph: RoadGraph, net: RoadNet, *, k: int, inner: tuple[bool, bool], left_hand: bool
) -> Iterator[str]:
    """The lanes of a road, from left to right; at a joint each continues as the lane in the same place.

    inner : whether another lane section of the road comes before and after
    """
    road = net.roads[k]
    sign = 1 if left_hand else -1  # of the lanes along the reference line
    flip = {}  # sign of the connected lane at each joint and section
    for end, word in ((START, "predecessor"), (END, "successor")):
        if inner[end]:
            flip[word] = 1
        elif (k, end) in net.joints:
            flip[word] = -1 if net.joints[k, end][1] == end else 1
    sides: dict[int, list[str]] = {}
    ahead: list[tuple[str, float]] = [(lane.kind, lane.width) for lane in road.ahead]
    if road.shared:
        ahead = [("bidirectional", road.shared), *ahead]
    back: list[tuple[str, float]] = [(lane.kind, lane.width) for lane in road.back]
    for side, edge, own in ((sign, road.edge, ahead), (-sign, road.twin, back)):
        lanes = []
        for number, (kind, width) in enumerate(own, start=1):
            mark = "broken" if number < len(own) else "none"
            speed = float(graph.speed[edge if edge >= 0 else road.edge])
            links = {word: by * side * number for word, by in flip.items()}
            lanes.append(_lane(side * number, kind, width=width, mark=mark, links=links, speed=speed))
        if road.shoulder > _THIN:
            links = {word: by * side * (len(own) + 1) for word, by in flip.items()}
            lanes.append(_lane(side * (len(own) + 1), "shoulder", width=road.shoulder, links=links))
        sides[side] = lanes
    middle = "solid" if road.back and road.ahead and not road.shared else "none"
    if sides[1]:
        yield from ("<left>\n", *reversed(sides[1]), "</left>\n")
    yield f'<center><lane id="0" type="none" level="false"><link/>{_road_mark(middle)}</lane></center>\n'
    if sides[-1]:
        yield from ("<right>\n", *sides[-1], "</right>\n")


def _lane(
    number: int,
    kind: str,
    *,
    width: float,
    links: dict[str, int],
    growth: float = 0.0,
    mark: str = "none",
    speed: float | None = None,
) -> str:
    """A lane whose width grows evenly; ``links`` are the lanes before and after it."""
    linked = "".join(f'<{word} id="{other}"/>' for word, other in links.items())
    limit = "" if speed is None else f'<speed sOffset="0" max="{_n(round(speed, 4))}" unit="m/s"/>'
    return (
        f'<lane id="{number}" type="{kind}" level="false"><link>{linked}</link>'
        f'<width sOffset="0" a="{_n(width)}" b="{_n(growth)}" c="0" d="0"/>{_road_mark(mark)}{limit}</lane>\n'
    )


def _road_mark(kind: str) -> str:
    width = "" if kind == "none" else ' width="0.12"'
    return (
        f'<roadMark sOffset="0" type="{kind}" weight="standard" color="standard"{width} laneChange="none"/>'
    )


def _signals(
    road: Carriageway, k: int, *, controls: dict[int, list[tuple[float, str]]], left_hand: bool
) -> Iterator[str]:
    """Signals and signs of each direction, on its side of the road."""
    count = 0
    total = road.plan.total
    for edge in (road.edge, road.twin):
        along = edge == road.edge
        for share, kind in controls.get(edge, []):
            if kind not in _SIGNALS:
                continue
            count += 1
            dynamic, country, code = _SIGNALS[kind]
            place = (share if along else 1 - share) * road.whole - road.begins
            s = min(max(place, 0.0), total)
            across = road.shared + sum(lane.width for lane in (*road.ahead, *road.back))
            t = (across / 2 + road.shoulder + 0.5) * (1 if along == left_hand else -1)
            high = "3" if dynamic == "yes" else "2.2"
            yield (
                f'<signal s="{_n(s)}" t="{_n(t)}" id="{k + 1}{count:03d}" name="{kind}" dynamic="{dynamic}" '
                f'orientation="{"+" if along else "-"}" zOffset="{high}" country="{country}" type="{code}" '
                f'subtype="-1" value="-1" height="0.9" width="0.6" hOffset="0" pitch="0" roll="0"/>'
            )


def _connecting_road(
    graph: RoadGraph, net: RoadNet, *, c: Connection, number: int, junctions: dict[int, int], left_hand: bool
) -> Iterator[str]:
    curve = c.curve
    rule = "LHT" if left_hand else "RHT"
    side, sign = ("left", 1) if left_hand else ("right", -1)
    yield (
        f'<road name="" length="{_n(curve.length)}" id="{number}" junction="{junctions[c.node]}" '
        f'rule="{rule}">\n<link>'
    )
    source, target = net.roads[net.road_of[c.before]], net.roads[net.road_of[c.after]]
    leaves = "end" if c.before == source.edge else "start"
    enters = "start" if c.after == target.edge else "end"
    for word, edge, point in (("predecessor", c.before, leaves), ("successor", c.after, enters)):
        other = int(net.road_of[edge]) + 1
        yield f'<{word} elementType="road" elementId="{other}" contactPoint="{point}"/>'
    speed = min(float(graph.speed[c.before]), float(graph.speed[c.after]))
    kind = _type(graph, c.before)
    yield f'</link>\n<type s="0" type="{kind}">{_speed(speed)}</type>\n<planView>\n'
    u, v = (dict(zip("abcd", w.tolist(), strict=True)) for w in (curve.u, curve.v))
    coefficients = " ".join(
        f'{letter}{axis}="{value:.12g}"' for axis, w in (("U", u), ("V", v)) for letter, value in w.items()
    )
    shape = f'<paramPoly3 {coefficients} pRange="normalized"/>'
    yield _geometry(0.0, curve.x, y=curve.y, heading=curve.heading, length=curve.length, shape=shape)
    a, b, cc, d = c.rise.tolist()
    yield (
        f'</planView>\n<elevationProfile><elevation s="0" a="{_n(a)}" b="{_n(b)}" c="{cc:.12g}" '
        f'd="{d:.12g}"/></elevationProfile>\n<lateralProfile/>\n<lanes>\n<laneSection s="0">\n'
    )
    middle = f'<center><lane id="0" type="none" level="false"><link/>{_road_mark("none")}</lane></center>\n'
    lanes = []
    for k, ((before, after), kind, (start, end)) in enumerate(
        zip(c.lanes.tolist(), c.kinds, c.widths.tolist(), strict=True)
    ):
        links = {"predecessor": before, "successor": after}
        growth = (end - start) / max(curve.length, 1e-3)
        number = sign * (k + 1)
        lanes.append(_lane(number, kind, width=start, growth=growth, links=links, speed=speed))
    if left_hand:
        yield f"<{side}>\n{''.join(reversed(lanes))}</{side}>\n{middle}"
    else:
        yield f"{middle}<{side}>\n{''.join(lanes)}</{side}>\n"
    yield "</laneSection>\n</lanes>\n</road>\n"


def _junctions(net: RoadNet, junctions: dict[int, int], *, first: int, left_hand: bool) -> Iterator[str]:
    """Each junction with its connections, whose order is that of the connecting roads."""
    sign = 1 if left_hand else -1
    ways: dict[int, list[tuple[int, Connection]]] = defaultdict(list)
    for k, connection in enumerate(net.connections):
        ways[connection.node].append((first + k, connection))
    for node, number in junctions.items():
        yield f'<junction name="" id="{number}" type="default">\n'
        for k, (road, c) in enumerate(ways[node]):
            incoming = int(net.road_of[c.before]) + 1
            yield (
                f'<connection id="{k}" incomingRoad="{incoming}" connectingRoad="{road}" '
                f'contactPoint="start">'
            )
            for lane, (before, _) in enumerate(c.lanes.tolist()):
                yield f'<laneLink from="{before}" to="{sign * (lane + 1)}"/>'
            yield "</connection>\n"
        yield "</junction>\n"


def write_sumo(scene: Scene, path: Path, *, progress: Progress = silent) -> Summary:
    """Write the road graph as a SUMO network (``.net.xml``).

    The network is converted by ``netconvert`` of the package eclipse-sumo from a file as of
    `write_opendrive`, in which a single lane for both directions is a lane in each half of it, as
    netconvert lets traffic drive lanes of the type ``bidirectional`` in one direction only. Comments of
    the network contain the time of day and are removed. Warnings are notes of the summary, one for each
    kind. Edge -7 is the right side of road 7 of `write_opendrive`.

    Raises MissingExtraError without eclipse-sumo, SceneFormatError for a scene without roads, GeosceneError
    with the last line of netconvert's output if that fails.
    """
    home = Path(need("sumo", "sumo").SUMO_HOME)
    with temporary_folder(path, "roads") as folder:
        roads, net = folder / "roads.xodr", folder / "roads.net.xml"
        roads_summary = _write(scene, roads, split_shared=True, progress=progress)
        files = ("--opendrive-files", roads, "--output-file", net)
        # Halves of narrow lanes stay open to cars; `_warnings` counts the warnings of a kind.
        options = ("--opendrive.min-width", "0", "--aggregate-warnings", "-1")
        command = (home / "bin" / "netconvert", *files, *options)
        # no shell; only the folder's name comes from the user
        run = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if run.returncode or not net.exists():
            lines = [line for line in run.stderr.splitlines() if line.strip()] or ["no message"]
            raise GeosceneError(f"netconvert failed: {lines[-1]}")
        with atomic_file(path) as out:
            out.write(_STAMP.sub(b"", net.read_bytes()))
    notes = (*roads_summary.notes, *_warnings(run.stderr))
    return Summary.of(path, "sumo", objects=roads_summary.objects, crs=scene.frame.name, notes=notes)


def _warnings(text: str) -> list[str]:
    """One line for each kind of warning of netconvert: their number and the first one."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("Warning: "):
            warning = line.removeprefix("Warning: ").strip()
            found.setdefault(_VALUES.sub("%", warning), []).append(warning)
    return [
        f"netconvert: {same[0]}" + (f" ({len(same)} warnings of this kind)" if len(same) > 1 else "")
        for same in found.values()
    ]
