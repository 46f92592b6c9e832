"""Shapes of trees with relief: crowns of leaf clusters on branches, conifers in tiers, palms with fronds."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.objects.solids import Body, lathe, solid
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Float

Profile = tuple[tuple[float, float], ...]

_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""Radians between leaves that follow each other on a stem: the golden angle."""

VARIANTS = 3
"""Shapes of each habit: with a heading of its own, no tree beside another looks like its copy."""


@dataclass(frozen=True, slots=True)
class Habit:
    """The growth form of trees.

    form     : ``broadleaved``, ``needleleaved`` or ``palm``
    profile  : outline of the crown as (diameter, z), both over those of the crown; its volume is that of the
               leaves' envelope, by which the leaf area of a tree is known
    clusters : number of leaf clusters (tiers of a conifer, fronds of a palm)
    cluster  : their diameter over that of the crown, and their height over their diameter in a crown that is
               as high as wide
    branches : number of limbs
    crown    : diameter of the crown over the height of the tree: assumed, but for `round` (see `CROWN`)
    base     : height of the crown's lower end over the height of the tree: assumed
    """

    form: str
    profile: Profile
    clusters: int
    cluster: tuple[float, float]
    branches: int
    crown: float
    base: float


_ROUND = ((0, 0), (0.65, 0.13), (0.97, 0.38), (0.97, 0.62), (0.65, 0.87), (0, 1))
_OVOID = ((0, 0), (0.75, 0.1), (1.0, 0.32), (0.85, 0.6), (0.45, 0.87), (0, 1))
_COLUMN = ((0, 0), (0.7, 0.06), (1.0, 0.35), (0.85, 0.75), (0, 1))
_DOME = ((0, 0), (0.9, 0.05), (1.0, 0.5), (0.7, 0.85), (0, 1))
_FLAME = ((0, 0), (0.8, 0.06), (1.0, 0.35), (0.7, 0.75), (0, 1))
_DISC = ((0, 0.3), (0.7, 0.4), (1.0, 0.62), (0.75, 0.9), (0, 1))
_CONE = ((0, 0), (1, 0.05), (0, 1))

HABITS: dict[str, Habit] = {
    "round": Habit("broadleaved", _ROUND, 13, (0.42, 0.85), branches=5, crown=0.67, base=0.3),
    "ovoid": Habit("broadleaved", _OVOID, 13, (0.4, 0.6), branches=4, crown=0.5, base=0.22),
    "columnar": Habit("broadleaved", _COLUMN, 9, (0.72, 0.36), branches=0, crown=0.2, base=0.08),
    "weeping": Habit("broadleaved", _DOME, 15, (0.3, 2.0), branches=4, crown=0.85, base=0.12),
    "conical": Habit("needleleaved", _CONE, 9, (1.0, 0.3), branches=0, crown=0.4, base=0.08),
    "cypress": Habit("needleleaved", _FLAME, 5, (0.95, 0.42), branches=0, crown=0.15, base=0.04),
    "umbrella": Habit("needleleaved", _DISC, 11, (0.4, 0.75), branches=6, crown=0.75, base=0.5),
    "palm": Habit("palm", _ROUND, 11, (0.5, 1.0), branches=0, crown=0.45, base=0.7),
}
"""Growth forms by name."""

_OF_GENUS = {
    "ovoid": "alnus betula corylus fraxinus ginkgo liquidambar liriodendron magnolia prunus pyrus sorbus",
    "weeping": "salix",
    "columnar": "populus",
    "cypress": "chamaecyparis cupressus juniperus taxus thuja",
    "umbrella": "cedrus pinus",
}
_GENERA = {genus: habit for habit, genera in _OF_GENUS.items() for genus in genera.split()}

_WORDS = {
    "betula pendula": "ovoid",
    "fastigiat": "columnar", "columnar": "columnar", "pyramidal": "columnar", "italica": "columnar",
    "pendul": "weeping", "babylonica": "weeping", "tristis": "weeping",
    "pinus sylvestris": "umbrella", "pinus nigra": "conical", "pinus strobus": "conical",
    "populus alba": "round", "populus tremula": "ovoid", "salix caprea": "round",
}  # fmt: skip
"""Parts of the names of species and cultivars that tell a habit that differs from that of the genus."""

_OF_FORM = {"broadleaved": "round", "needleleaved": "conical", "palm": "palm"}


def habit_of(names: str, *, form: str) -> tuple[str, bool]:
    """Growth habit of a tree, and whether its botanical name gives it; else the usual one of its form.

    names : genus, species and cultivar, in one text
    """
    text = names.lower()
    for word, habit in _WORDS.items():
        if word in text and HABITS[habit].form == form:
            return habit, True
    genus = text.split(" ")[0]
    if genus in _GENERA and HABITS[_GENERA[genus]].form == form:
        return _GENERA[genus], True
    return _OF_FORM[form], False


@functools.cache
def tree_shapes() -> dict[str, Mesh]:
    """Trunks and crowns with relief, of unit size like the plain ones, by name."""
    made = {"trunk_flared": _trunk(0.55), "trunk_palm": _trunk(0.85)}
    for name, habit in HABITS.items():
        for nth in range(VARIANTS):
            made[f"crown_{name}_{nth}"] = _crown(name, habit, nth=nth)
    return made


@functools.cache
def leaf_area_densities(base: tuple[tuple[str, float], ...]) -> dict[str, float]:
    """Leaf area per volume of leaf clusters, m2/m3, by shape.

    The leaves of a tree are those of its envelope, filled evenly; clusters hold them in less room, and are as
    much denser. Where clusters overlap, their leaves add up, as they do for rays.

    base : (form, leaf area density of the envelope) pairs
    """
    density = dict(base)
    out = {}
    for name, habit in HABITS.items():
        envelope = _volume(lathe(habit.profile))
        for nth in range(VARIANTS):
            shape = tree_shapes()[f"crown_{name}_{nth}"]
            leaves = shape.faces[shape.klass == Class.TREE_CROWN]
            held = _volume((shape.vertices, leaves))
            out[f"crown_{name}_{nth}"] = round(density[habit.form] * envelope / held, 3)
    return out


def _volume(body: Body) -> float:
    points, faces = body
    a, b, c = (points[faces[:, k]] for k in range(3))
    return float(np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6.0)


def _trunk(top: float) -> Mesh:
    """A trunk with a root flare; a fifth up it has its diameter, at its upper end the share ``top`` of it."""
    rings: Profile = ((0, 0), (1.9, 0.0), (1.25, 0.05), (1.06, 0.1), (1.0, 0.2), (top, 1.0), (0, 1.0))
    points, faces = lathe(rings, sides=7)
    # The flare follows a few roots.
    angle = np.arctan2(points[:, 1], points[:, 0])
    lobes = np.where(points[:, 2] < 0.08, 1.0 + 0.15 * np.cos(3 * angle), 1.0)
    points[:, :2] *= lobes[:, None]
    return solid((points, faces), klass=Class.TRUNK, material="bark")


def _crown(name: str, habit: Habit, *, nth: int) -> Mesh:
    """One variant of a habit's crown, within the unit box."""
    seed = 1 + list(HABITS).index(name)
    draw = uniform_at(np.arange(256), np.full(256, nth), count=4, seed=seed)  # (4, 256)
    if habit.form == "palm":
        leaves, limbs = _fronds(habit, draw), np.empty((0, 3))
    elif name == "conical":
        leaves, limbs = _tiers(habit, draw), np.empty((0, 3))
    elif name == "weeping":
        leaves, limbs = _curtain(habit, draw)
    else:
        leaves, limbs = _clusters(habit, draw)
    material = "conifer" if habit.form == "needleleaved" else "foliage"
    parts = [solid(body, klass=Class.TREE_CROWN, material=material) for body in _fit(leaves)]
    parts += [solid(_limb(tip), klass=Class.TRUNK, material="bark") for tip in limbs[: habit.branches]]
    return concatenate(parts)


def _fit(bodies: Sequence[Body]) -> list[Body]:
    """The bodies, scaled together to z from 0 (or their lower end) to 1 and to x, y = +-0.5."""
    every = np.concatenate([points for points, _ in bodies])
    across = 0.5 / np.hypot(every[:, 0], every[:, 1]).max()
    low, high = max(every[:, 2].min(), 0.0), every[:, 2].max()
    bottom = low if low > 0.05 else 0.0
    lowest = every[:, 2].min()
    up = (1.0 - bottom) / (high - lowest)
    return [
        (np.column_stack([points[:, :2] * across, bottom + (points[:, 2] - lowest) * up]), faces)
        for points, faces in bodies
    ]


def _radius(habit: Habit, z: Float) -> Float:
    """Radius of the envelope at heights z."""
    diameter, height = np.array(habit.profile, float).T
    return np.asarray(np.interp(z, height, diameter / 2), float)


def _clusters(habit: Habit, draw: Float) -> tuple[list[Body], Float]:
    """Leaf clusters inside the envelope, and where limbs end: the lowest clusters."""
    width, slender = habit.cluster
    n = habit.clusters
    low, high = habit.profile[0][1], habit.profile[-1][1]
    half = width * slender / 2
    # Heights at equal shares of the envelope's volume, so that it is evenly filled.
    grid = np.linspace(low, high, 200)
    share = np.cumsum(_radius(habit, grid) ** 2)
    z = np.interp((np.arange(n) + 0.5) / n, share / share[-1], grid)
    z = np.clip(z, low + half, high - half)
    turn = _GOLDEN * np.arange(n) + 2 * np.pi * draw[0, 0]
    out = np.maximum(_radius(habit, z) - width / 2, 0.0) * np.where(np.arange(n) % 3 == 2, 0.35, 1.0)
    centre = np.column_stack([out * np.cos(turn), out * np.sin(turn), z])
    centre += (draw[1:4, :n].T - 0.5) * [0.08, 0.08, 0.05]
    size = width * (0.85 + 0.35 * draw[3, :n])
    bodies = [
        _cluster(centre[k], (size[k], size[k] * slender), draw=np.roll(draw[2], 7 * k)) for k in range(n)
    ]
    outer = np.flatnonzero(np.arange(n) % 3 != 2)
    return bodies, centre[outer]


def _cluster(centre: Float, size: tuple[float, float], *, draw: Float) -> Body:
    """A ball of leaves about a point, of some width and height, with an uneven surface."""
    width, height = size
    points, faces = _ball()
    radius = 0.5 * (0.75 + 0.45 * draw[: len(points)])
    return centre + points * radius[:, None] * [width, width, height], faces


@functools.cache
def _ball() -> Body:
    """A ball of radius 1: an icosahedron whose edges are in three parts each, 180 faces."""
    corners, triangles = _icosahedron()
    # Barycentric coordinates of the points of a triangle, and its nine parts.
    grid = [(i, j) for i in range(4) for j in range(4 - i)]
    number = {place: k for k, place in enumerate(grid)}
    share = np.array([(3 - i - j, i, j) for i, j in grid]) / 3
    parts = [[number[i, j], number[i + 1, j], number[i, j + 1]] for i, j in grid if i + j < 3]
    parts += [[number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]] for i, j in grid if i + j < 2]
    points = (share @ corners[triangles]).reshape(-1, 3)
    # Triangles share the points on their edges.
    _, first, same = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    faces = same.reshape(-1)[10 * np.arange(len(triangles))[:, None, None] + np.array(parts)]
    points = points[first] / np.linalg.norm(points[first], axis=1, keepdims=True)
    return points, faces.reshape(-1, 3).astype(np.int32)


@functools.cache
def _icosahedron() -> Body:
    """Regular icosahedron of radius 1 with a vertex at the bottom."""
    ring = np.arange(5)
    level, flat = 1 / np.sqrt(5.0), 2 / np.sqrt(5.0)
    upper, lower = 2 * np.pi * ring / 5, 2 * np.pi * (ring + 0.5) / 5
    points = np.vstack(
        [
            [[0.0, 0.0, 1.0]],
            np.column_stack([flat * np.cos(upper), flat * np.sin(upper), np.full(5, level)]),
            np.column_stack([flat * np.cos(lower), flat * np.sin(lower), np.full(5, -level)]),
            [[0.0, 0.0, -1.0]],
        ]
    )
    ahead = (ring + 1) % 5
    faces = np.vstack(
        [
            np.column_stack([np.zeros(5, int), 1 + ring, 1 + ahead]),
            np.column_stack([1 + ring, 6 + ring, 1 + ahead]),
            np.column_stack([1 + ahead, 6 + ring, 6 + ahead]),
            np.column_stack([np.full(5, 11), 6 + ahead, 6 + ring]),
        ]
    )
    return points, faces.astype(np.int32)


def _limb(tip: Float) -> Body:
    """A limb from the trunk, below the tip, outwards and up to the tip: a slender pyramid of three sides."""
    start = np.array([0.0, 0.0, max(tip[2] - 0.9 * float(np.hypot(*tip[:2])) - 0.05, 0.02)])
    along = (tip - start) / np.linalg.norm(tip - start)
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    other = np.cross(along, side)
    turn = 2 * np.pi * np.arange(3) / 3
    ring = start + 0.016 * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    body = np.vstack([ring, tip]), faces
    return body if _volume(body) > 0 else (body[0], faces[:, ::-1])


def _tiers(habit: Habit, draw: Float) -> list[Body]:
    """Tiers of boughs that hang outwards, each a cone with uneven rim."""
    n, sides = habit.clusters, 17
    bodies = []
    for k in range(n):
        low = k / (n + 0.6)
        high = min(low + 2.1 / (n + 0.6), 1.0) if k < n - 1 else 1.0
        reach = 0.5 * (1.0 - low) ** 0.9
        turn = 2 * np.pi * (np.arange(sides) + draw[0, k]) / sides
        uneven = np.where(np.arange(sides) % 2 == 0, 1.0, 0.72) * (0.88 + 0.24 * draw[1, k : k + sides])
        rim = np.column_stack([np.cos(turn), np.sin(turn)]) * (reach * uneven)[:, None]
        droop = low + 0.03 * draw[2, k : k + sides]
        inner = low + 0.45 * (high - low) * 0.5
        points = np.vstack([[[0.0, 0.0, inner]], np.column_stack([rim, droop]), [[0.0, 0.0, high]]])
        ring = np.arange(sides)
        ahead = (ring + 1) % sides
        faces = np.vstack(
            [
                np.column_stack([np.zeros(sides, int), 1 + ahead, 1 + ring]),
                np.column_stack([1 + ring, 1 + ahead, np.full(sides, sides + 1)]),
            ]
        )
        bodies.append((points, faces.astype(np.int32)))
    return bodies


def _curtain(habit: Habit, draw: Float) -> tuple[list[Body], Float]:
    """A dome of clusters, and twigs that hang from it almost to the ground."""
    top, hanging = 5, habit.clusters - 5
    width, slender = habit.cluster
    dome = 2 * np.pi * (np.arange(top) + draw[0, 0]) / top
    crowns = np.column_stack([0.22 * np.cos(dome), 0.22 * np.sin(dome), 0.72 + 0.08 * draw[1, :top]])
    turn = 2 * np.pi * (np.arange(hanging) + 0.3 * draw[0, 1 : 1 + hanging]) / hanging
    out = 0.3 + 0.07 * draw[2, :hanging]
    length = width * slender * (0.85 + 0.4 * draw[3, :hanging])
    middle = np.column_stack([out * np.cos(turn), out * np.sin(turn), 0.72 - length / 2])
    bodies = [_cluster(crowns[k], (0.55, 0.45), draw=np.roll(draw[2], 5 * k)) for k in range(top)]
    bodies += [
        _cluster(middle[k], (0.75 * width, float(length[k])), draw=np.roll(draw[1], 3 * k))
        for k in range(hanging)
    ]
    return bodies, crowns


def _fronds(habit: Habit, draw: Float) -> list[Body]:
    """Arched fronds from the top of the stem, each a thin blade with a ridge."""
    bodies = []
    for k in range(habit.clusters):
        turn = 2 * np.pi * (k + 0.5 * draw[0, k]) / habit.clusters * 2.0
        rise = (0.5, 0.1)[k % 2] + 0.15 * draw[1, k]
        along = np.array([0.0, 0.35, 0.75, 1.0])
        out = 0.5 * along * (0.85 + 0.15 * draw[2, k])
        z = 0.4 + rise * np.sin(np.pi * along * 0.62) - 0.42 * along**2.2
        half = np.array([0.012, 0.075, 0.06, 0.0])
        sections = []
        for r, h, w in zip(out[:3], z[:3], half[:3], strict=True):
            sections.append(
                [[r, -w, h - 0.5 * w], [r, 0.0, h - 0.012], [r, w, h - 0.5 * w], [r, 0.0, h + 0.012]]
            )
        points = np.vstack([*sections, [[out[3], 0.0, z[3]]]])
        ring = np.arange(4)
        ahead = (ring + 1) % 4
        faces = [np.array([[0, 2, 1], [0, 3, 2]])]
        for s in (0, 4):
            faces += [
                np.column_stack([s + ring, s + ahead, s + 4 + ahead]),
                np.column_stack([s + ring, s + 4 + ahead, s + 4 + ring]),
            ]
        faces.append(np.column_stack([8 + ring, 8 + ahead, np.full(4, 12)]))
        c, s_ = np.cos(turn), np.sin(turn)
        bodies.append(
            (
                points @ np.array([[c, s_, 0.0], [-s_, c, 0.0], [0.0, 0.0, 1.0]]),
                np.vstack(faces).astype(np.int32),
            )
        )
    return bodies
