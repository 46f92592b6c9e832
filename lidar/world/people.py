"""Bodies of people: standing, walking and riding."""

from __future__ import annotations

import numpy as np

from geoscene.geometry.mesh import Mesh
from geoscene.typing import Float
from lidar.world.actor_solids import DARK, Rgb, ball, limb, loft

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
    parts += _head((0.0, _CHIN * h), h)
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
        parts += _arm(
            np.array([0.0, side * 0.125 * h, 0.80 * h]), -0.8 * angle, bend=0.25, h=h, jacket=jacket
        )
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
        shoulder = np.array([top[0], side * 0.115 * h, top[1] - 0.02 * h])
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
