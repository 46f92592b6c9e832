"""Closed solids from which bodies are composed, and bodies of people: standing, walking and riding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.objects.solids import lathe
from geoscene.typing import Float

Rgb = tuple[int, int, int]

GLASS: Rgb = (52, 60, 68)
"""Colour of tinted panes."""
DARK: Rgb = (28, 28, 30)
RED: Rgb = (170, 20, 20)
WHITE: Rgb = (238, 238, 232)


def paint(points: Float, faces: NDArray[np.integer], *, material: str, color: Rgb | None = None) -> Mesh:
    """A closed mesh of one material, without a class; in the material's colour by default.

    Faces that all point inwards are flipped.
    """
    of = materials()[material]
    mesh = Mesh.of(points, faces, material=of.code, color=color or of.color, closed=True)
    return mesh if volume(mesh) > 0 else replace(mesh, faces=mesh.faces[:, ::-1].copy())


def repaint(mesh: Mesh, faces: NDArray[np.bool_], *, material: str, color: Rgb | None = None) -> Mesh:
    """The mesh with another material on some of its faces."""
    of = materials()[material]
    return replace(
        mesh,
        material=np.where(faces, of.code, mesh.material).astype(np.uint8),
        color=np.where(faces[:, None], color or of.color, mesh.color).astype(np.uint8),
    )


def body(parts: Sequence[Mesh], klass: Class) -> Mesh:
    """One mesh of all parts, of one class."""
    whole = concatenate(parts)
    return replace(whole, klass=np.full(len(whole), klass, np.uint8))


def loft(rings: ArrayLike, material: str = "car_paint", *, color: Rgb | None = None) -> Mesh:
    """The closed solid through rings (k, n, 3) of corners, all in the same sense.

    Faces are in the order: two for each side of each span between rings, then the lids at the first and the
    last ring.
    """
    points = np.asarray(rings, float)
    k, n, _ = points.shape
    ring = np.arange(n)
    ahead = np.roll(ring, -1)
    low = n * np.arange(k - 1)[:, None]
    side = np.stack(
        [
            np.stack([low + ring, low + ring + n, low + ahead + n], axis=-1),
            np.stack([low + ring, low + ahead + n, low + ahead], axis=-1),
        ],
        axis=2,
    ).reshape(-1, 3)
    fan = np.column_stack([np.zeros(n - 2, int), ring[1:-1], ring[2:]])
    return paint(
        points.reshape(-1, 3),
        np.vstack([side, fan, fan[:, ::-1] + n * (k - 1)]),
        material=material,
        color=color,
    )


def sides(spans: int, corners: int) -> NDArray[np.int64]:
    """Span and side (m, 2) of each face of a loft; -1 and -2 for the lids at its first and last ring."""
    span, side = np.divmod(np.arange(spans * corners).repeat(2), corners)
    lids = np.repeat([-1, -2], corners - 2)
    return np.column_stack([np.concatenate([span, lids]), np.concatenate([side, lids])])


def box(
    low: Sequence[float],
    high: Sequence[float],
    *,
    material: str = "car_paint",
    color: Rgb | None = None,
    taper: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """A box between two corners; ``taper`` is the ratio of the top's size to the bottom's along x and y."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    floor = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]])
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    lid = (floor - middle) * [*taper, 1.0] + middle + [0.0, 0.0, z1 - z0]
    return loft(np.stack([floor, lid])[:, ::-1], material, color=color)


def mirror(mesh: Mesh) -> list[Mesh]:
    """A part on the left and its mirror image on the right."""
    other = replace(mesh, vertices=mesh.vertices * [1.0, -1.0, 1.0], faces=mesh.faces[:, ::-1].copy())
    return [mesh, other]


def wheel(x: float, y: float, *, radius: float, width: float, corners: int = 18) -> Mesh:
    """A wheel about (x, y) on the ground: a tyre with a metal disc on both sides."""
    turn = 2 * np.pi * np.arange(corners) / corners
    rings = []
    for side, share in ((-1, 0.64), (-1, 1.0), (1, 1.0), (1, 0.64)):
        r = share * radius
        rings.append(
            np.column_stack(
                [x + r * np.cos(turn), np.full(corners, y + side * width / 2), radius + r * np.sin(turn)]
            )
        )
    tyre = loft(np.array(rings), "tyre")
    return repaint(tyre, sides(3, corners)[:, 0] < 0, material="metal")


def hoop(x: float, radius: float, *, width: float, corners: int = 20) -> Mesh:
    """A bicycle wheel in the plane y = 0 on the ground at x: a tyre without spokes."""
    turn = 2 * np.pi * np.arange(corners) / corners
    ring = np.column_stack([np.cos(turn), np.zeros(corners), np.sin(turn)])
    side = np.array([0.0, width / 2, 0.0])
    tubes = np.stack(
        [
            radius * ring - side,
            radius * ring + side,
            (radius - width) * ring + side,
            (radius - width) * ring - side,
        ]
    )
    ahead = np.roll(np.arange(corners), -1)
    faces = []
    for a in range(4):
        p, q = a * corners, (a + 1) % 4 * corners
        here = np.arange(corners)
        faces += [
            np.column_stack([p + here, q + ahead, q + here]),
            np.column_stack([p + here, p + ahead, q + ahead]),
        ]
    return paint(tubes.reshape(-1, 3) + np.array([x, 0.0, radius]), np.vstack(faces), material="tyre")


def limb(
    start: ArrayLike,
    end: ArrayLike,
    *,
    thick: tuple[float, float],
    material: str = "clothing",
    color: Rgb | None = None,
    flat: float = 1.0,
    corners: int = 6,
) -> Mesh:
    """A tapering bar between two points; ``thick`` is its width at each, ``flat`` its depth against that."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = (b - a) / np.linalg.norm(b - a)
    aside = np.array([0.0, 1.0, 0.0]) if abs(along[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    u = np.cross(aside, along)
    u /= np.linalg.norm(u)
    v = np.cross(along, u)
    turn = -2 * np.pi * np.arange(corners) / corners
    ring = np.outer(np.cos(turn), u) * flat + np.outer(np.sin(turn), v)
    return loft(np.stack([a + ring * thick[0] / 2, b + ring * thick[1] / 2]), material, color=color)


def ball(centre: ArrayLike, size: Sequence[float], *, material: str, color: Rgb | None = None) -> Mesh:
    """An ellipsoid of 48 faces of the given sizes along x, y and z."""
    points, faces = lathe([(0, -0.5), (0.7, -0.35), (1.0, 0.0), (0.7, 0.35), (0, 0.5)], sides=8)
    return paint(points * size + np.asarray(centre, float), faces, material=material, color=color)


def volume(mesh: Mesh) -> float:
    """Signed volume in cubic metres; positive where closed parts face outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


Clothes = tuple[Rgb, Rgb]

_LEG, _HIP, _SHOULDER, _CHIN = 0.48, 0.53, 0.82, 0.87
"""Heights of hip joints, bottom and top of the torso, and chin as shares of an adult's stature."""
_SWING = np.radians(26.0)
"""Largest angle of a leg from the vertical at walking speed."""
SKIN: Rgb = (198, 152, 122)
HAIR: Rgb = (62, 46, 36)
"""Colours of skin and hair."""


def person(stature: float, clothes: Clothes, *, phase: float | None) -> list[Mesh]:
    """A person who walks along x; ``phase`` 0 to 2 pi of a stride of two steps, None for standing."""
    jacket, trousers = clothes
    h = stature
    swing = 0.0 if phase is None else _SWING * np.sin(phase)
    left, right = (0.0, 0.0) if phase is None else (max(sign * np.cos(phase), 0.0) for sign in (1, -1))
    parts = _trunk((0.0, _HIP * h), (0.0, _SHOULDER * h), h=h, jacket=jacket)
    parts += [_shoulders(0.0, 0.79 * h, h=h, jacket=jacket), *_head((0.0, _CHIN * h), h)]
    for side, angle, bend in ((1, swing, left), (-1, -swing, right)):
        hip = np.array([0.0, side * 0.052 * h, _LEG * h + 0.05 * h])
        knee = hip + 0.25 * h * np.array([np.sin(angle + 0.35 * bend), 0.0, -np.cos(angle + 0.35 * bend)])
        shin = angle - 0.5 * bend
        ankle = knee + 0.24 * h * np.array([np.sin(shin), 0.0, -np.cos(shin)])
        parts += [
            limb(hip, knee, thick=(0.105 * h, 0.075 * h), color=trousers),
            limb(knee, ankle, thick=(0.075 * h, 0.05 * h), color=trousers),
            _shoe(ankle, (0.03 * h, 0.015 * h), toe=(0.10 * h, 0.02 * h), thick=(0.05 * h, 0.04 * h)),
        ]
        parts += _arm(np.array([0.0, side * 0.12 * h, 0.79 * h]), -0.8 * angle, bend=0.25, h=h, jacket=jacket)
    return _ground_parts(parts)


def rider(
    seat: tuple[float, float],
    grip: tuple[float, float],
    *,
    foot: tuple[float, float],
    stature: float,
    clothes: Clothes,
    crank: float | None = None,
    helmet: Rgb | None = None,
) -> list[Mesh]:
    """A person who sits at ``seat`` (x, z), holds bars at ``grip`` and has the feet at ``foot``.

    crank  : angle of the pedals about ``foot`` in radians; feet at rest by default
    helmet : its colour, none by default
    """
    jacket, trousers = clothes
    h = stature
    lean = 0.42 if crank is not None else 0.3
    top = (seat[0] + 0.30 * h * np.sin(lean), seat[1] + 0.30 * h * np.cos(lean))
    parts = _trunk(seat, top, h=h, jacket=jacket)
    parts.append(_shoulders(top[0], top[1] - 0.03 * h, h=h, jacket=jacket))
    parts += _head((top[0] + 0.02 * h, top[1] + 0.05 * h), h, helmet=helmet)
    for side in (1, -1):
        turn = 0.0 if crank is None else crank + (0.0 if side > 0 else np.pi)
        reach = 0.0 if crank is None else 0.17
        hip = np.array([seat[0], side * 0.05 * h, seat[1]])
        ankle = np.array([foot[0] + reach * np.cos(turn), side * 0.09, foot[1] + 0.08 + reach * np.sin(turn)])
        knee = _joint(hip, ankle, first=0.26 * h, second=0.25 * h)
        parts += [
            limb(hip, knee, thick=(0.10 * h, 0.075 * h), color=trousers),
            limb(knee, ankle, thick=(0.075 * h, 0.05 * h), color=trousers),
            _shoe(ankle, (0.05, 0.03), toe=(0.16, 0.03), thick=(0.08, 0.06)),
        ]
        shoulder = np.array([top[0], side * 0.115 * h, top[1] - 0.03 * h])
        hand = np.array([grip[0], side * 0.24, grip[1]])
        elbow = (shoulder + hand) / 2 + [-0.02, side * 0.05, -0.06]
        parts += [
            limb(shoulder, elbow, thick=(0.055 * h, 0.045 * h), color=jacket),
            limb(elbow, hand, thick=(0.045 * h, 0.035 * h), color=jacket),
        ]
    return parts


def _shoe(
    ankle: Float, heel: tuple[float, float], *, toe: tuple[float, float], thick: tuple[float, float]
) -> Mesh:
    """A shoe; heel and toe are metres behind and before the ankle, and below it."""
    back, front = np.array([heel[0], 0.0, heel[1]]), np.array([toe[0], 0.0, -toe[1]])
    return limb(ankle - back, ankle + front, thick=thick, material="tyre", color=DARK)


def _trunk(low: tuple[float, float], high: tuple[float, float], *, h: float, jacket: Rgb) -> list[Mesh]:
    turn = -2 * np.pi * np.arange(8) / 8
    rings = []
    for share, deep, wide in (
        (-0.06, 0.055, 0.075),
        (0.0, 0.068, 0.095),
        (0.45, 0.062, 0.085),
        (0.85, 0.068, 0.118),
        (1.0, 0.045, 0.075),
        (1.12, 0.028, 0.03),
    ):
        x, z = (a + share * (b - a) for a, b in zip(low, high, strict=True))
        rings.append(np.column_stack([x + deep * h * np.cos(turn), wide * h * np.sin(turn), np.full(8, z)]))
    return [loft(np.array(rings), "clothing", color=jacket)]


def _head(chin: tuple[float, float], h: float, *, helmet: Rgb | None = None) -> list[Mesh]:
    x, z = chin
    face = ball(
        (x + 0.005, 0.0, z + 0.062 * h), (0.115 * h, 0.09 * h, 0.125 * h), material="skin", color=SKIN
    )
    if helmet is not None:
        middle, size = (x, 0.0, z + 0.075 * h), (0.15 * h, 0.135 * h, 0.13 * h)
        return [face, ball(middle, size, material="car_paint", color=helmet)]
    middle, size = (x - 0.012 * h, 0.0, z + 0.078 * h), (0.112 * h, 0.098 * h, 0.104 * h)
    return [face, ball(middle, size, material="clothing", color=HAIR)]


def _arm(shoulder: Float, angle: float, *, bend: float, h: float, jacket: Rgb) -> list[Mesh]:
    elbow = shoulder + 0.17 * h * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    hand = elbow + 0.15 * h * np.array([np.sin(angle + bend), 0.0, -np.cos(angle + bend)])
    return [
        limb(shoulder, elbow, thick=(0.055 * h, 0.045 * h), color=jacket),
        limb(elbow, hand, thick=(0.045 * h, 0.035 * h), color=jacket),
        ball(hand, (0.05 * h, 0.03 * h, 0.055 * h), material="skin", color=SKIN),
    ]


def _shoulders(x: float, z: float, *, h: float, jacket: Rgb) -> Mesh:
    """A bar across the trunk from arm to arm, which closes the gaps between them."""
    reach = np.array([0.0, 0.14 * h, 0.0])
    middle = np.array([x, 0.0, z - 0.015 * h])
    return limb(middle - reach, middle + reach, thick=(0.065 * h, 0.065 * h), color=jacket)


def _joint(a: Float, b: Float, *, first: float, second: float) -> Float:
    """Position of the knee, bent forwards, for given lengths of thigh and shank."""
    d = b - a
    far = min(float(np.linalg.norm(d)), 0.999 * (first + second))
    along = (first**2 - second**2 + far**2) / (2 * far)
    up = np.sqrt(max(first**2 - along**2, 0.0))
    unit = d / np.linalg.norm(d)
    forward = np.array([1.0, 0.0, 0.0]) - unit * unit[0]
    knee: Float = a + along * unit + up * forward / np.linalg.norm(forward)
    return knee


def _ground_parts(parts: list[Mesh]) -> list[Mesh]:
    """Parts shifted vertically so that the lowest point is on the ground."""
    low = min(float(part.vertices[:, 2].min()) for part in parts)
    return [part.shifted([0.0, 0.0, -low]) for part in parts]
