"""Published results of attacks and defences, for comparison with measured ones.

They are of other detectors, sensors and data: bands to compare with, not values to reach.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PublishedResult:
    """A published result.

    low, high : shares that bound it; equal for a single value, None if the source gives none
    text      : what it is of
    source    : where it is from
    """

    low: float | None
    high: float | None
    text: str
    source: str


ATTACKS = {
    "adv-lidar": PublishedResult(
        0.75, 0.75, "white-box phantom of 60 points 5 m ahead, success about 75 %", "Cao et al. 2019"
    ),
    "black-box": PublishedResult(
        0.8,
        0.8,
        "traces of occluded and far cars, 200 points at 5 to 8 m, mean success about 80 %",
        "Sun et al. 2020",
    ),
    "object-removal": PublishedResult(
        None,
        None,
        "200 points moved outwards by 2 m; loss of recall depends on the detector",
        "Hau et al. 2021",
    ),
    "physical-removal": PublishedResult(
        0.927, 0.927, "removal of 90 % of a target's points, success 92.7 %", "Cao et al. 2023"
    ),
    "high-frequency": PublishedResult(
        None,
        None,
        "at least 96 % of the points in the window removed; no success rate is stated",
        "Sato et al. 2024, 2025",
    ),
    "pla": PublishedResult(
        None,
        None,
        "up to 4200 points in 30 x 30 degrees, positions within 0.1 m; no success rate is stated",
        "Jin et al. 2023",
    ),
    "wraith": PublishedResult(
        None,
        None,
        "ghost over several frames; the best earlier defences remove fewer than 30 % of forged cars",
        "arXiv 2303.09731",
    ),
}
"""Success of attacks, by key of the option ``published``."""

DEFENCES = {
    "occlusion": PublishedResult(
        None,
        None,
        "CARLO lowers the mean success of black-box forgery from 80 % to 5.5 %",
        "Sun et al. 2020",
    ),
    "shadow": PublishedResult(
        0.94, None, "Shadow-Catcher: accuracy over 94 %, 3 to 21 ms per object", "Hau et al. 2020"
    ),
    "temporal": PublishedResult(
        0.98,
        None,
        "3D-TC2: over 98 % of the attacks, 41 Hz; ADoPT: over 85 % at under 10 % false alarms",
        "You et al. 2021",
    ),
    "void": PublishedResult(
        None, None, "fake shadow detection: alarm over 15 cubic metres without an occluder", "Cao et al. 2023"
    ),
}
"""Detection of attacks, by defence."""
