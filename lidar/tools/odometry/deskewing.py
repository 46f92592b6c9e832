"""Even motion of a body: parts of it, and points without it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.typing import Float


def turns(motion: Float, share: Float) -> Rotation:
    """Rotations at times (n,) in steps of a motion (4, 4), which turns evenly."""
    return Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(motion[:3, :3]).as_rotvec())


def still(points: Float, share: Float, *, motion: Float) -> Float:
    """Points (n, 3) in the vehicle's frame at the time of share 0, without the vehicle's motion.

    points : (n, 3) in the vehicle's frame, each at its own time
    share  : (n,) times, in steps of the motion
    motion : (4, 4) of the vehicle in one step: rotation and translation grow evenly with time
    """
    moved: Float = turns(motion, share).apply(points) + share[:, None] * motion[:3, 3]
    return moved


def moved_back(points: Float, share: Float, *, motion: Float) -> Float:
    """Points (n, 3) of the frame at share 0 in the frames that a body has at shares (n,) of a motion."""
    if not share.any():
        return points
    moved: Float = turns(motion, share).inv().apply(points - share[:, None] * motion[:3, 3])
    return moved


def scaled_motion(motion: Float, factor: float) -> Float:
    """The motion (4, 4) in ``factor`` times the time: rotation and translation grow evenly."""
    out = np.eye(4)
    out[:3, :3] = turns(motion, np.array([factor])).as_matrix()[0]
    out[:3, 3] = factor * motion[:3, 3]
    return out
