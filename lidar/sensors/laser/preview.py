"""A point cloud as notebooks show it: from above, coloured by class, and the number of returns by class."""

from __future__ import annotations

import numpy as np

from geoscene.classes import Class, class_codes
from geoscene.drawing.previews import DARK, PreviewPlan, around, card
from lidar.sensors.laser.cloud import Cloud

_NEAR = np.array([[-5.0, -5.0], [5.0, 5.0]])
"""Metres around the scanner that a picture shows at least."""

_SCANNER = (255, 90, 60)


def png(cloud: Cloud) -> bytes:
    """A PNG picture of a cloud in the sensor frame, x to the right, with a mark where the scanner is."""
    xyz = cloud.xyz.astype(np.float64)
    plan = PreviewPlan(around(np.vstack([xyz[:, :2], _NEAR])), DARK)
    plan.points(xyz, class_codes().color[cloud.klass])
    plan.line([[0.0, 0.0]], _SCANNER)
    return plan.png()


def html(cloud: Cloud) -> str:
    """The picture and a table."""
    codes, counts = np.unique(cloud.klass, return_counts=True)
    ranked = np.argsort(-counts, kind="stable").tolist()
    rows = [(Class(int(codes[k])).name.lower().replace("_", " "), f"{counts[k]:,}") for k in ranked]
    return card(f"{len(cloud):,} returns", rows, picture=png(cloud))
