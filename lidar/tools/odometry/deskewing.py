"""Sweeps without the motion of the vehicle, as far as that motion is known."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from geoscene.typing import Float


def still(points: Float, share: Float, *, motion: Float) -> Float:
    """Points (n, 3) in the vehicle's frame at the time of share 0, without the vehicle's motion.

    points : (n, 3) in the vehicle's frame, each at its own time
    share  : (n,) times, in steps of the motion
    motion : (4, 4) of the vehicle in one step: rotation and translation grow evenly with time
    """
    turn = Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(motion[:3, :3]).as_rotvec())
    moved: Float = turn.apply(points) + share[:, None] * motion[:3, 3]
    return moved
