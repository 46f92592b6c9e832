"""A synthetic city as an OpenStreetMap extract, for measuring builds of any size.

    python benchmarks/make_osm.py 100000 city.osm.pbf [--seed 0]

Blocks between streets, densest in the centre: closed courts, terraced houses, detached houses with garages,
factories, towers of several parts, parks; a river with bridges; forest and fields around. A third of the
buildings have a height or a number of storeys. The same number of buildings and seed give the same map.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Tags = dict[str, str]

CENTRE = (8.4037, 49.0069)
"""Longitude and latitude of the city centre, degrees."""

TURN = np.radians(17.0)
"""Angle between streets and axes, so that no street lies along a grid line."""

PITCH = (124.0, 92.0)
"""Metres between streets; blocks of European towns are about 100 m by 70 m."""

HALF_STREET = 8.0
"""Metres from a street's centre line to the adjacent plots."""

A_BLOCK = 12.5
"""Buildings in an average block; it determines the number of blocks."""

RIVER_ROW = -2
"""Row of blocks that the river replaces."""


@dataclass(slots=True)
class City:
    """A map under construction; coordinates in metres along and across the streets."""

    places: list[tuple[float, float]] = field(default_factory=list)
    node_tags: dict[int, Tags] = field(default_factory=dict)
    ways: list[tuple[list[int], Tags]] = field(default_factory=list)
    relations: list[tuple[list[tuple[str, int, str]], Tags]] = field(default_factory=list)
    buildings: int = 0

    def node(self, x: float, y: float, tags: Tags | None = None) -> int:
        """Id of a new node."""
        self.places.append((x, y))
        if tags:
            self.node_tags[len(self.places)] = tags
        return len(self.places)

    def nodes(self, xy: Float) -> list[int]:
        """Ids of new nodes."""
        return [self.node(x, y) for x, y in xy.tolist()]

    def way(self, refs: list[int], tags: Tags) -> int:
        """Id of a new way."""
        self.ways.append((refs, tags))
        return len(self.ways)

    def ring(self, refs: list[int], tags: Tags) -> int:
        """Id of a new closed way."""
        return self.way([*refs, refs[0]], tags)

    def building(self, refs: list[int], tags: Tags) -> None:
        """A building on a closed way."""
        self.ring(refs, tags)
        self.buildings += 1


def rectangle(x: float, y: float, width: float, depth: float, *, angle: float = 0.0) -> Float:
    """Corners (4, 2) of a rectangle around a point, counter-clockwise."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, depth / 2)
    return turned(corners, angle) + np.array([x, y])


def turned(xy: Float, angle: float) -> Float:
    """Points (n, 2) rotated about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return xy @ np.array([[c, s], [-s, c]])


def height_tags(rng: np.random.Generator, levels: int) -> Tags:
    """Height tags of a building: mostly none, often the storeys, rarely metres."""
    draw = rng.random()
    if draw < 0.25:
        return {"building:levels": str(levels)}
    return {"height": f"{levels * 3.1 + 1.5:.1f}"} if draw < 0.33 else {}


def roof_tags(rng: np.random.Generator, shapes: tuple[str, ...]) -> Tags:
    """Tags of a roof shape, for every third building."""
    if rng.random() > 0.33:
        return {}
    tags = {"roof:shape": str(rng.choice(shapes))}
    return tags | ({"roof:levels": "1"} if rng.random() < 0.4 else {})


def terrace(city: City, rng: np.random.Generator, box: Float, houses: int, levels: int, use: str) -> None:
    """Houses in a row along x that share their walls; the box is (xmin, ymin, xmax, ymax)."""
    x = np.linspace(box[0], box[2], houses + 1)
    step = np.where(rng.random(houses) < 0.3, rng.uniform(1.0, 3.0, houses), 0.0)
    below = city.nodes(np.column_stack([x, np.full(houses + 1, box[1])]))
    above = city.nodes(np.column_stack([x, np.full(houses + 1, box[3])]))
    for k in range(houses):
        refs = [below[k], below[k + 1], above[k + 1], above[k]]
        if step[k]:  # a bay towards the yard
            middle = x[k : k + 2].mean()
            bay = [(x[k + 1] - 1.5, box[3]), (x[k + 1] - 1.5, box[3] + step[k])]
            bay += [(middle, box[3] + step[k]), (middle, box[3])]
            refs[3:3] = city.nodes(np.array(bay))
        tags = {"building": use} | height_tags(rng, levels + int(rng.integers(-1, 2)))
        city.building(refs, tags | roof_tags(rng, ("gabled", "gabled", "mansard", "flat")))


def court(city: City, rng: np.random.Generator, box: Float) -> None:
    """A closed court: one building with a hole, a house in the yard, trees."""
    depth = rng.uniform(11.0, 14.0)
    inner = box + np.array([depth, depth, -depth, -depth])
    rings = []
    for b in (box, inner):
        refs = city.nodes(np.array([(b[0], b[1]), (b[2], b[1]), (b[2], b[3]), (b[0], b[3])]))
        rings.append(city.ring(refs, {}))
    members = [("w", rings[0], "outer"), ("w", rings[1], "inner")]
    tags = {"type": "multipolygon", "building": "apartments"} | height_tags(rng, 5)
    city.relations.append((members, tags | roof_tags(rng, ("gabled", "hipped", "flat"))))
    city.buildings += 1
    x, y = (inner[0] + inner[2]) / 2, (inner[1] + inner[3]) / 2
    if rng.random() < 0.6:
        city.building(city.nodes(rectangle(x, y, 14.0, 8.0)), {"building": "yes"})
    for dx in (-16.0, 16.0):
        city.node(x + dx, y + rng.uniform(-5, 5), {"natural": "tree"})


def houses(city: City, rng: np.random.Generator, box: Float) -> None:
    """Detached houses in two rows, L-shaped or plain, with garages and garden trees."""
    count = int(rng.integers(5, 7))
    for side in (0, 1):
        y = (box[1] + 12.0) if side == 0 else (box[3] - 12.0)
        for x in np.linspace(box[0] + 9.0, box[2] - 9.0, count):
            width, depth = rng.uniform(8.0, 11.5), rng.uniform(9.0, 12.0)
            corners = rectangle(0.0, 0.0, width, depth)
            if rng.random() < 0.35:
                wing = rng.uniform(2.5, 4.0)
                corners = np.vstack(
                    [corners[:2], (width / 2, 0.0), (width / 2 - wing, 0.0), (width / 2 - wing, depth / 2),
                     corners[3:]]
                )  # fmt: skip
            corners = turned(corners, rng.normal(0.0, 0.06)) + np.array([x, y + rng.normal(0.0, 1.0)])
            tags = {"building": str(rng.choice(["house", "house", "detached", "yes"]))}
            tags |= height_tags(rng, 2) | roof_tags(rng, ("gabled", "gabled", "hipped", "half-hipped"))
            city.building(city.nodes(corners), tags)
            if rng.random() < 0.3:
                yard = y + (14.0 if side == 0 else -14.0)
                city.building(city.nodes(rectangle(x + 4.0, yard, 3.5, 6.0)), {"building": "garage"})
            if rng.random() < 0.3:
                city.node(x - 6.0, y + (9.0 if side == 0 else -9.0), {"natural": "tree"})


def works(city: City, rng: np.random.Generator, box: Float) -> None:
    """Factory halls with a chimney and a car park."""
    x = np.linspace(box[0], box[2], 4)
    for a, b in pairwise(x):
        corners = rectangle((a + b) / 2, (box[1] + box[3]) / 2, (b - a) * 0.8, (box[3] - box[1]) * 0.6)
        tags = {"building": str(rng.choice(["industrial", "warehouse", "retail"]))}
        city.building(city.nodes(corners), tags | height_tags(rng, 3) | roof_tags(rng, ("flat", "skillion")))
    lot = rectangle((box[0] + box[2]) / 2, box[3] - 6.0, (box[2] - box[0]) * 0.7, 10.0)
    city.ring(city.nodes(lot), {"amenity": "parking"})


def towers(city: City, rng: np.random.Generator, box: Float) -> None:
    """Two towers on a base, mapped as building parts, on a lawn with trees."""
    for x in np.linspace(box[0] + 28.0, box[2] - 28.0, 2):
        y = (box[1] + box[3]) / 2
        levels = int(rng.integers(9, 22))
        outline = {"building": "apartments", "building:levels": str(levels)}
        city.building(city.nodes(rectangle(x, y, 36.0, 30.0)), outline)
        city.ring(city.nodes(rectangle(x, y, 36.0, 30.0)), {"building:part": "yes", "building:levels": "3"})
        shaft = rectangle(x, y, 18.0, 18.0, angle=rng.uniform(0.0, 0.6))
        city.ring(city.nodes(shaft), {"building:part": "yes", "building:levels": str(levels)})
    lawn = np.array([(box[0], box[1]), (box[2], box[1]), (box[2], box[1] + 16), (box[0], box[1] + 16)])
    city.ring(city.nodes(lawn), {"landuse": "grass"})


def park(city: City, rng: np.random.Generator, box: Float) -> None:
    """A park with paths, a pond, a hedge and trees."""
    corners = np.array([(box[0], box[1]), (box[2], box[1]), (box[2], box[3]), (box[0], box[3])])
    refs = city.nodes(corners)
    city.ring(refs, {"leisure": "park"})
    city.way([refs[0], refs[2]], {"highway": "footway", "surface": "gravel"})
    city.way(city.nodes(corners[:2] + np.array([0.0, 2.0])), {"barrier": "hedge", "height": "1.5"})
    angle = np.linspace(0.0, 2 * np.pi, 20, endpoint=False)
    middle = np.array([box[0] + box[2], box[1] + box[3]]) / 2 + (22.0, -10.0)
    pond = middle + np.column_stack([np.cos(angle) * 14.0, np.sin(angle) * 8.0])
    city.ring(city.nodes(pond), {"natural": "water", "water": "pond"})
    for x, y in rng.uniform(box[:2] + 4.0, box[2:] - 4.0, (25, 2)).tolist():
        if np.hypot(x - middle[0], y - middle[1]) > 18.0:
            tags = {"natural": "tree"} | ({"leaf_type": "needleleaved"} if rng.random() < 0.2 else {})
            city.node(x, y, tags)


def block(city: City, rng: np.random.Generator, box: Float, away: float) -> None:
    """One block; ``away`` is its distance from the centre as a share of the city's radius."""
    draw = rng.random()
    if draw < 0.05:
        park(city, rng, box)
    elif away < 0.3 and draw < 0.45:
        court(city, rng, box)
    elif away < 0.55 and draw < 0.9:
        for y in (box[1], box[3] - 12.0):
            row = np.array([box[0], y, box[2], y + 12.0])
            terrace(city, rng, row, int(rng.integers(7, 11)), 4, "apartments" if away < 0.4 else "terrace")
    elif draw < 0.12:
        works(city, rng, box)
    elif draw < 0.17:
        towers(city, rng, box)
    else:
        houses(city, rng, box)


def outskirts(city: City, rng: np.random.Generator, box: Float) -> None:
    """Forest or fields."""
    corners = np.array([(box[0], box[1]), (box[2], box[1]), (box[2], box[3]), (box[0], box[3])])
    refs = city.nodes(corners + rng.uniform(-3.0, 3.0, (4, 2)))
    kind = str(rng.choice(["forest", "farmland", "meadow"]))
    city.ring(refs, {"landuse": kind} | ({"leaf_type": "mixed"} if kind == "forest" else {}))


def street_tags(line: int, *, across: bool) -> Tags:
    """Class, lanes and speed limit of the street on a grid line."""
    name = {"name": f"{'Quer' if across else 'Lang'}straße {line}"}
    if line % 8 == 0:
        return name | {"highway": "primary", "lanes": "4", "maxspeed": "50", "sidewalk": "both"}
    if line % 4 == 0:
        return name | {"highway": "tertiary", "lanes": "2", "maxspeed": "50"}
    return name | {"highway": "residential", "maxspeed": "30"}


def streets(city: City, half: int) -> None:
    """The street grid with signals, crossings, tree rows, and bridges over the river."""
    lines = np.arange(-half, half + 1).tolist()
    joint = {}
    for i in lines:
        for j in lines:
            tags = None
            if i % 8 == 0 and j % 4 == 0:
                tags = {"highway": "traffic_signals"}
            elif i % 4 == 0 and j % 4 == 0:
                tags = {"highway": "crossing", "crossing": "marked"}
            joint[i, j] = city.node(i * PITCH[0], j * PITCH[1], tags)
    for j in lines:
        city.way([joint[i, j] for i in lines], street_tags(j, across=True))
        if j % 4 == 0:
            row = np.array([(i * PITCH[0] + dx, j * PITCH[1] + 6.5) for i in lines[:-1] for dx in (20, 104)])
            for a in range(0, len(row), 2):
                city.way(city.nodes(row[a : a + 2]), {"natural": "tree_row"})
    for i in lines:
        tags, column = street_tags(i, across=False), [joint[i, j] for j in lines]
        # a street ends at the banks; where it crosses the river, the bridge is a separate way
        at = RIVER_ROW + half
        if not 0 <= at < len(lines) - 1:
            city.way(column, tags)
            continue
        bank = [city.node(i * PITCH[0], (RIVER_ROW + part) * PITCH[1]) for part in (0.12, 0.88)]
        city.way([*column[: at + 1], bank[0]], tags)
        if i % 2 == 0:
            city.way(bank, tags | {"bridge": "yes", "layer": "1"})
        city.way([bank[1], *column[at + 1 :]], tags)


def river(city: City, half: int) -> None:
    """A river along the whole city."""
    x = np.linspace(-half - 0.5, half + 0.5, 4 * half + 3) * PITCH[0]
    middle = (RIVER_ROW + 0.5) * PITCH[1] + 4.0 * np.sin(x / 150.0)
    city.way(city.nodes(np.column_stack([x, middle])), {"waterway": "river", "name": "Lauf"})
    banks = [np.column_stack([x, middle - 24.0]), np.column_stack([x, middle + 24.0])[::-1]]
    city.ring(city.nodes(np.vstack(banks)), {"natural": "water", "water": "river"})


def make_city(buildings: int, seed: int) -> City:
    """A city of ``count`` buildings (up to 20 more, since blocks are complete)."""
    city = City()
    half = max(int(np.ceil(np.sqrt(buildings / A_BLOCK) / 2)) + 1, 3)
    cells = np.array([(i, j) for i in range(-half, half) for j in range(-half, half)])
    middle = (cells + 0.5) * PITCH
    away = np.hypot(*middle.T)
    radius = np.sqrt(buildings / A_BLOCK * PITCH[0] * PITCH[1] / np.pi)
    streets(city, half)
    river(city, half)
    for row in np.argsort(away, kind="stable").tolist():
        i, j = cells[row].tolist()
        if j == RIVER_ROW:
            continue
        rng = np.random.Generator(np.random.Philox(key=[seed, (i + half) * 4 * half + j + half]))
        low, high = np.array([i, j]) * PITCH + HALF_STREET + 3.0, np.array([i + 1, j + 1]) * PITCH
        box = np.concatenate([low, high - HALF_STREET - 3.0])
        if city.buildings < buildings:
            block(city, rng, box, float(away[row] / radius))
        else:
            outskirts(city, rng, box)
    return city


def on_globe(xy: Float) -> Float:
    """Longitudes and latitudes (n, 2) in degrees of points in the city, on a sphere of 6371 km."""
    metre = np.degrees(1.0 / 6_371_000.0)
    lonlat: Float = CENTRE + turned(xy, TURN) * metre / np.array([np.cos(np.radians(CENTRE[1])), 1.0])
    return lonlat


def write_city(city: City, path: Path) -> None:
    """Write a city as .osm.pbf."""
    import osmium  # noqa: PLC0415 - heavy

    lonlat = on_globe(np.array(city.places))
    path.unlink(missing_ok=True)
    header = osmium.io.Header()
    header.set("generator", "make_osm.py")
    header.set("osmosis_replication_timestamp", "2026-01-01T00:00:00Z")
    corners = np.concatenate([lonlat.min(axis=0), lonlat.max(axis=0)]).tolist()
    header.add_box(osmium.osm.Box(*corners))
    writer = osmium.SimpleWriter(str(path), header=header)
    try:
        for k, place in enumerate(lonlat.tolist(), start=1):
            tags = city.node_tags.get(k, {})
            writer.add_node(osmium.osm.mutable.Node(id=k, location=tuple(place), tags=tags, version=1))
        for k, (refs, tags) in enumerate(city.ways, start=1):
            writer.add_way(osmium.osm.mutable.Way(id=k, nodes=refs, tags=tags, version=1))
        for k, (members, tags) in enumerate(city.relations, start=1):
            writer.add_relation(osmium.osm.mutable.Relation(id=k, members=members, tags=tags, version=1))
    finally:
        writer.close()


def main() -> None:
    """Write one city."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("buildings", type=int)
    parser.add_argument("path", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    city = make_city(given.buildings, given.seed)
    write_city(city, given.path)
    print(f"{given.path}: {city.buildings} buildings, {len(city.places)} nodes, {len(city.ways)} ways")


if __name__ == "__main__":
    main()
