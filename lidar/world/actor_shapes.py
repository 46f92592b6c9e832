"""Bodies of road users: cars, vans, lorries, buses, two-wheelers and people, as closed parametric solids.

Frame of a body: x forward, y left, z up, origin on the ground below the centre of its bounding box.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh
from lidar.world.actor_solids import (
    DARK,
    GLASS,
    RED,
    WHITE,
    Rgb,
    body,
    box,
    hoop,
    limb,
    loft,
    mirror,
    person,
    repaint,
    rider,
    sides,
    wheel,
)


@dataclass(frozen=True, slots=True)
class ActorShape:
    """A body that actors are instances of.

    name   : kind and variant: ``sedan/white``
    kind   : one of `KINDS`
    klass  : its class
    length, width, height : of the bounding box, metres
    base   : wheelbase in metres, or the distance between the feet of a pose
    mesh   : closed solids, frame as in the module's first lines
    """

    name: str
    kind: str
    klass: Class
    length: float
    width: float
    height: float
    base: float
    mesh: Mesh


KINDS = (
    *("sedan", "hatchback", "suv", "van", "truck", "bus"),
    *("motorcycle", "parked_motorcycle", "bicycle", "cyclist"),
    *("adult", "small_adult", "child"),
)
"""Kinds of bodies. A motorcycle has its rider, a parked one and a bicycle have none."""

PAINTS: dict[str, tuple[Rgb, float]] = {
    "white": ((232, 232, 228), 0.29),
    "black": ((22, 22, 26), 0.22),
    "grey": ((96, 98, 102), 0.19),
    "silver": ((182, 185, 188), 0.10),
    "blue": ((32, 58, 118), 0.10),
    "red": ((150, 24, 28), 0.06),
    "green": ((40, 74, 58), 0.02),
    "beige": ((176, 162, 134), 0.02),
}
"""Colours of cars and their shares: assumed, close to the statistics of paint makers for new cars."""

STRIDE = 4
"""Poses of a stride (two steps) of a pedestrian."""
CLOTHES: dict[str, tuple[Rgb, Rgb]] = {
    "navy": ((36, 44, 78), (44, 46, 52)),
    "grey": ((120, 122, 126), (52, 62, 92)),
    "red": ((150, 40, 42), (40, 40, 44)),
    "pale": ((206, 198, 182), (96, 84, 68)),
}
"""Jackets and trousers of people."""


_seat = functools.partial(box, material="clothing", color=DARK)
_pane = functools.partial(box, material="glass", color=GLASS)
_lamp = functools.partial(box, material="glass", color=WHITE)
_reflector = functools.partial(box, material="retroreflector", color=RED)


def _car(size: tuple[float, float, float], *, profile: str, paint: Rgb) -> list[Mesh]:
    """A car: body, cabin, wheels, seats, lamps, plates and mirrors."""
    length, width, height = size
    half, w = length / 2, width / 2 - 0.01
    belt = 0.63 * height
    # stations along the body: share of the length, share of the width, bottom and top
    nose, tail = 0.50 * height, 0.58 * height if profile == "sedan" else belt
    stations = (
        (-1.00, 0.86, 0.34, tail - 0.10),
        (-0.96, 0.94, 0.24, tail),
        (-0.70, 1.00, 0.20, belt),
        (-0.10, 1.00, 0.19, belt),
        (0.42, 1.00, 0.19, belt - 0.02),
        (0.90, 0.95, 0.20, nose + 0.06),
        (1.00, 0.80, 0.30, nose - 0.10),
    )
    rings = []
    for at, wide, low, high in stations:
        y, mid = w * wide, (low + high) / 2
        rings.append(
            [(at * half, a * y, z)
             for a, z in ((0.86, low), (1.0, mid - 0.1), (0.99, mid + 0.1), (0.88, high),
                          (-0.88, high), (-0.99, mid + 0.1), (-1.0, mid - 0.1), (-0.86, low))]
        )  # fmt: skip
    shell = loft(rings, color=paint)
    corner = sides(len(stations) - 1, 8)[:, 1]
    shell = repaint(shell, corner == 7, material="tyre", color=DARK)
    # the cabin: start and end of its glass, and its roof
    start, roof0, roof1, end = {
        "sedan": (0.40, 0.10, -0.42, -0.76),
        "hatchback": (0.44, 0.12, -0.74, -0.97),
        "suv": (0.40, 0.12, -0.80, -0.95),
    }[profile]
    sill = belt - 0.08
    cabin = []
    for at, z, lean in (
        (end, belt - 0.02, 0.93),
        (roof1, height - 0.02, 0.76),
        (roof0, height, 0.76),
        (start, belt - 0.03, 0.93),
    ):
        cabin.append([(at * half, a * w, h) for a, h in ((0.92, sill), (lean, z), (-lean, z), (-0.92, sill))])
    glass = loft(cabin, color=paint)
    span, side = sides(3, 4).T
    pane = ((side == 0) | (side == 2) | ((side == 1) & (span != 1))) & (span >= 0)
    glass = repaint(glass, pane, material="glass", color=GLASS)
    radius = 0.36 if profile == "suv" else 0.315
    base = 0.29 * length
    parts = [shell, glass]
    for x in (-base, base):
        parts += mirror(wheel(x, w - 0.10, radius=radius, width=0.21))
    parts += [_seat((-0.62 * half, -0.8 * w, 0.3), (-0.4 * half, 0.8 * w, height - 0.35))]
    parts += mirror(_seat((-0.12 * half, 0.12 * w, 0.3), (0.02 * half, 0.75 * w, height - 0.32)))
    lamp = nose - 0.14
    parts += mirror(_lamp((0.955 * half, 0.50 * w, lamp), (half + 0.002, 0.78 * w, lamp + 0.12)))
    rear = tail - 0.22
    parts += mirror(_reflector((-half - 0.002, 0.55 * w, rear), (-0.955 * half, 0.84 * w, rear + 0.12)))
    parts += [_plate(half - 0.012, 0.36), _plate(-half + 0.012, 0.52)]
    parts += mirror(box((0.26 * half, w - 0.06, belt), (0.31 * half, w + 0.01, belt + 0.13), color=paint))
    return parts


def _plate(x: float, z: float, *, y: float = 0.0) -> Mesh:
    """A number plate, 520 by 110 mm, that protrudes 12 mm from the body at the front or rear."""
    return box(
        (x - 0.024, y - 0.26, z), (x + 0.024, y + 0.26, z + 0.11), material="retroreflector", color=WHITE
    )


def _lamps(front: float, rear: float, *, w: float, z: float) -> list[Mesh]:
    """Lamps in front, reflecting lamps behind."""
    return [
        *mirror(_lamp((front - 0.05, 0.62 * w, z), (front + 0.012, 0.92 * w, z + 0.16))),
        *mirror(_reflector((rear - 0.012, 0.70 * w, z), (rear + 0.05, 0.93 * w, z + 0.16))),
    ]


def _van(size: tuple[float, float, float], paint: Rgb) -> list[Mesh]:
    """A delivery van: a box with a sloping front."""
    length, width, height = size
    half, w = length / 2 - 0.012, width / 2
    rings = []
    stations = (
        (-1.0, 0.30, height, 0.90),
        (0.30, 0.25, height, 0.90),
        (0.42, 0.25, height - 0.08, 0.88),
        (0.74, 0.25, 1.22, 0.94),
        (0.985, 0.27, 1.02, 0.90),
        (1.0, 0.36, 0.80, 0.86),
    )
    for at, low, high, top in stations:
        mid = min(1.15, 0.6 * (low + high))
        rings.append(
            [(at * half, a * w, z) for a, z in ((0.92, low), (1.0, 0.55), (1.0, mid), (top, high))]
            + [(at * half, -a * w, z) for a, z in ((top, high), (1.0, mid), (1.0, 0.55), (0.92, low))]
        )
    shell = loft(rings, color=paint)
    span, side = sides(5, 8).T
    shell = repaint(shell, (side == 3) & (span == 2), material="glass", color=GLASS)
    shell = repaint(shell, np.isin(side, (2, 4)) & np.isin(span, (1, 2)), material="glass", color=GLASS)
    shell = repaint(shell, side == 7, material="tyre", color=DARK)
    parts = [
        shell,
        _seat((0.12 * half, -0.8 * w, 0.5), (0.24 * half, 0.8 * w, 1.6)),
    ]
    for x in (-0.29 * length, 0.31 * length):
        parts += mirror(wheel(x, w - 0.11, radius=0.34, width=0.23))
    return [*parts, *_lamps(half, -half, w=w, z=0.72), _plate(half - 0.01, 0.40), _plate(-half, 0.55)]


def _truck(size: tuple[float, float, float], paint: Rgb) -> list[Mesh]:
    """A lorry: cab, chassis and a box."""
    length, width, height = size
    half, w = length / 2 - 0.012, width / 2
    cab = half - 1.9
    windows = [
        [(x, a * w, z) for a, z in ((0.97, 1.5), (lean, top), (-lean, top), (-0.97, 1.5))]
        for x, top, lean in ((cab, 2.75, 0.92), (half - 0.25, 2.75, 0.92), (half - 0.02, 1.56, 0.96))
    ]
    parts = [
        box((cab, -0.97 * w, 0.55), (half, 0.97 * w, 1.55), color=paint),
        loft(windows, color=paint),
        box((-half, -0.42 * w, 0.6), (cab + 0.1, 0.42 * w, 0.98), material="metal", color=DARK),
        box((-half, -w, 0.96), (cab - 0.1, w, height), color=WHITE),
        box((-half, -0.95 * w, 0.45), (-half + 0.08, 0.95 * w, 0.6), material="metal", color=DARK),
    ]  # fmt: skip
    span, side = sides(2, 4).T
    parts[1] = repaint(
        parts[1],
        ((side == 1) & (span == 1)) | (np.isin(side, (0, 2)) & (span >= 0)),
        material="glass",
        color=GLASS,
    )
    for x in (-0.26 * length, 0.36 * length):
        parts += mirror(wheel(x, w - 0.15, radius=0.48, width=0.29))
    parts += [_reflector((-half - 0.004, -w * 0.9, 1.0), (-half + 0.02, w * 0.9, 1.1))]
    parts += _lamps(half, -half, w=w, z=0.75)
    return [*parts, _plate(half - 0.01, 0.58), _plate(-half, 0.62)]


def _bus(size: tuple[float, float, float], paint: Rgb) -> list[Mesh]:
    """A low-floor city bus."""
    length, width, height = size
    half, w = length / 2 - 0.012, width / 2
    rings = []
    for at, wide in ((-1.0, 0.97), (-0.99, 1.0), (0.985, 1.0), (1.0, 0.96)):
        levels = ((0.98, 0.30), (1.0, 1.05), (0.99, height - 0.65), (0.90, height))
        rings.append(
            [(at * half, a * wide * w, z) for a, z in levels]
            + [(at * half, -a * wide * w, z) for a, z in levels[::-1]]
        )
    shell = loft(rings, color=paint)
    span, side = sides(3, 8).T
    shell = repaint(shell, np.isin(side, (1, 5)) & (span == 1), material="glass", color=GLASS)
    shell = repaint(shell, side == 7, material="tyre", color=DARK)
    parts = [
        shell,
        _pane((half - 0.02, -0.88 * w, 1.0), (half + 0.01, 0.88 * w, height - 0.45)),
        _pane((-half - 0.01, -0.80 * w, 1.5), (-half + 0.02, 0.80 * w, height - 0.6)),
        _seat((-0.8 * half, -0.85 * w, 0.5), (0.75 * half, -0.25 * w, 1.35)),
        _seat((-0.8 * half, 0.25 * w, 0.5), (0.75 * half, 0.85 * w, 1.35)),
    ]
    for x in (-0.24 * length, 0.27 * length):
        parts += mirror(wheel(x, w - 0.14, radius=0.48, width=0.28))
    return [*parts, *_lamps(half, -half, w=w, z=0.62), _plate(half - 0.01, 0.40), _plate(-half + 0.01, 0.72)]


def _bicycle(paint: Rgb) -> list[Mesh]:
    """A city bicycle 1.76 m long: wheels of 28 inches, frame, fork, bars, saddle, reflectors."""
    r, x = 0.345, 0.53
    tubes = [
        ((-x, 0, r), (-0.12, 0, 0.28), 0.03), ((-0.12, 0, 0.28), (-0.24, 0, 0.88), 0.035),
        ((-0.12, 0, 0.28), (0.36, 0, 0.72), 0.04), ((-0.22, 0, 0.78), (0.34, 0, 0.80), 0.035),
        ((-x, 0, r), (-0.22, 0, 0.78), 0.025), ((x, 0, r), (0.33, 0, 0.98), 0.035),
    ]  # fmt: skip
    parts = [hoop(-x, r, width=0.04), hoop(x, r, width=0.04)]
    parts += [limb(a, b, thick=(d, d), material="car_paint", color=paint, corners=4) for a, b, d in tubes]
    parts += [
        limb((0.33, -0.29, 1.02), (0.33, 0.29, 1.02), thick=(0.03, 0.03), material="metal", corners=4),
        box((-0.36, -0.08, 0.88), (-0.12, 0.08, 0.94), material="tyre", color=DARK),
        *mirror(box((-0.17, 0.09, 0.24), (-0.07, 0.18, 0.27), material="tyre", color=DARK)),
        _reflector((-0.62, -0.04, 0.66), (-0.60, 0.04, 0.72)),
        box((0.40, -0.03, 0.84), (0.42, 0.03, 0.90), material="retroreflector", color=WHITE),
    ]
    return parts


def _motorcycle(paint: Rgb) -> list[Mesh]:
    """A motorcycle 2.1 m long, without a rider."""
    r, x = 0.31, 0.70
    stations = (
        (-0.85, 0.05, 0.72, 0.86),
        (-0.35, 0.13, 0.60, 0.80),
        (0.02, 0.15, 0.58, 0.86),
        (0.34, 0.16, 0.56, 0.98),
        (0.52, 0.08, 0.66, 0.90),
    )
    across = ((0.8, 0.0), (1.0, 0.5), (0.6, 1.0), (-0.6, 1.0), (-1.0, 0.5), (-0.8, 0.0))
    tank = [[(at, a * w, low + b * (high - low)) for a, b in across] for at, w, low, high in stations]
    parts = [
        wheel(-x, 0.0, radius=r, width=0.16),
        wheel(x, 0.0, radius=r, width=0.12),
        loft(tank, color=paint),
    ]
    parts += [
        box((-0.25, -0.14, 0.22), (0.32, 0.14, 0.60), material="metal", color=DARK),
        *mirror(limb((x, 0.09, r), (0.44, 0.09, 0.92), thick=(0.05, 0.05), material="metal", corners=4)),
        limb((0.40, -0.36, 0.98), (0.40, 0.36, 0.98), thick=(0.035, 0.035), material="metal", corners=4),
        limb((-x, 0.0, r), (-0.2, 0.0, 0.36), thick=(0.08, 0.08), material="metal", color=DARK, corners=4),
        _lamp((0.52, -0.09, 0.76), (0.58, 0.09, 0.92)),
        _reflector((-0.90, -0.07, 0.70), (-0.86, 0.07, 0.78)),
        box((-0.93, -0.09, 0.46), (-0.91, 0.09, 0.60), material="retroreflector", color=WHITE),
    ]
    return parts


def _motorcyclist(paint: Rgb) -> list[Mesh]:
    """A motorcycle with its rider."""
    clothes = (40, 40, 46), (30, 30, 34)
    on = rider((-0.22, 0.84), (0.38, 1.0), foot=(0.05, 0.34), stature=1.78, clothes=clothes, helmet=paint)
    return [*_motorcycle(paint), *on]


_SIZES: dict[str, tuple[float, float, float, float]] = {
    "sedan": (4.68, 1.82, 1.45, 0.58),
    "hatchback": (4.05, 1.75, 1.47, 0.58),
    "suv": (4.45, 1.85, 1.66, 0.58),
    "van": (5.30, 2.02, 2.40, 0.60),
    "truck": (8.40, 2.50, 3.45, 0.62),
    "bus": (12.00, 2.55, 3.05, 0.51),
}
"""Length, width and height in metres and the wheelbase as a share of the length.

Close to cars of segments D, C and J, a large van, a lorry of 12 t and a city bus; mirrors of the large ones
are left out.
"""

FLEET: dict[str, dict[str, Rgb]] = {
    "van": {"white": (232, 232, 228), "grey": (120, 122, 126), "blue": (32, 58, 118)},
    "truck": {"blue": (30, 62, 120), "red": (140, 30, 28)},
    "bus": {"red": (170, 30, 34), "blue": (24, 78, 140)},
    "motorcycle": {"black": (24, 24, 26), "red": (150, 24, 28)},
    "parked_motorcycle": {"black": (24, 24, 26), "red": (150, 24, 28)},
    "bicycle": {"black": (26, 26, 28), "blue": (40, 82, 140)},
}
"""Paints of other vehicles by kind."""

_CLASS = {
    "van": Class.VAN, "truck": Class.TRUCK, "bus": Class.BUS, "motorcycle": Class.MOTORCYCLIST,
    "parked_motorcycle": Class.MOTORCYCLE,
    "bicycle": Class.BICYCLE, "cyclist": Class.CYCLIST, "adult": Class.PEDESTRIAN,
    "small_adult": Class.PEDESTRIAN, "child": Class.PEDESTRIAN,
}  # fmt: skip

STATURE = {"adult": 1.78, "small_adult": 1.64, "child": 1.25}
"""Heights of people in metres."""


def _parts(kind: str, paint: Rgb) -> list[Mesh]:
    if kind in ("sedan", "hatchback", "suv"):
        return _car(_SIZES[kind][:3], profile=kind, paint=paint)
    if kind in ("van", "truck", "bus"):
        return {"van": _van, "truck": _truck, "bus": _bus}[kind](_SIZES[kind][:3], paint)
    return {"motorcycle": _motorcyclist, "parked_motorcycle": _motorcycle, "bicycle": _bicycle}[kind](paint)


@functools.cache
def catalogue() -> dict[str, ActorShape]:
    """All shapes by name, in a fixed order. People have `STRIDE` walking poses and one standing."""
    made: list[tuple[str, str, float, list[Mesh]]] = []
    paints = {name: color for name, (color, _) in PAINTS.items()}
    for kind in ("sedan", "hatchback", "suv", *FLEET):
        for name, paint in FLEET.get(kind, paints).items():
            size = _SIZES.get(kind)
            base = size[0] * size[3] if size else 1.2
            made.append((f"{kind}/{name}", kind, base, _parts(kind, paint)))
    for name, clothes in CLOTHES.items():
        pedals = [
            [
                *_bicycle(clothes[0]),
                *rider(
                    (-0.22, 0.95), (0.33, 1.03), foot=(-0.12, 0.28), stature=1.76, clothes=clothes, crank=turn
                ),
            ]
            for turn in np.pi / 2 * np.arange(STRIDE)
        ]
        made += [(f"cyclist/{name}/{k}", "cyclist", 1.06, parts) for k, parts in enumerate(pedals)]
    for kind, tall in STATURE.items():
        for name, clothes in CLOTHES.items():
            poses = [
                person(tall, clothes, phase=phase)
                for phase in (*(2 * np.pi / STRIDE * np.arange(STRIDE)), None)
            ]
            made += [(f"{kind}/{name}/{k}", kind, 0.4, parts) for k, parts in enumerate(poses)]
    figures: dict[str, list[tuple[str, str, float, Mesh]]] = {}
    for name, kind, base, parts in made:
        figure = "/".join(name.split("/")[:2])
        mesh = body(parts, _CLASS.get(kind, Class.CAR))
        figures.setdefault(figure, []).append((name, kind, base, mesh))
    return {shape.name: shape for poses in figures.values() for shape in _shapes(poses)}


def _shapes(poses: list[tuple[str, str, float, Mesh]]) -> list[ActorShape]:
    """The poses of one figure, in one box that holds all of them."""
    points = np.concatenate([mesh.vertices for _, _, _, mesh in poses])
    low, high = points.min(axis=0), points.max(axis=0)
    length, width, _ = (high - low).tolist()
    middle = [*(-(low + high)[:2] / 2), 0.0]
    return [
        ActorShape(
            name, kind, Class(int(mesh.klass[0])), length, width, float(high[2]), base, mesh.shifted(middle)
        )
        for name, kind, base, mesh in poses
    ]
