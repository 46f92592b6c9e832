"""The detector without learning, on clouds of a scanner with 16 beams over simple shapes."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from lidar.tools.detection import Detections, detect
from lidar.tools.detection.ground import height_above_ground

_HEIGHT = 1.8


@dataclass(frozen=True)
class _Box:
    x: float
    y: float
    size: tuple[float, float, float]
    yaw: float = 0.0
    bottom: float = 0.15


def _cloud(
    *boxes: _Box, gradient: float = 0.0, beams: int = 16, lowest: float = -15.0, highest: float = 15.0
) -> NDArray[np.float64]:
    """Returns (n, 3) of a scanner 1.8 m over a plane that rises with x."""
    azimuth = np.deg2rad(np.arange(0, 360, 0.2))
    elevation = np.deg2rad(np.linspace(lowest, highest, beams))
    a, e = (part.ravel() for part in np.meshgrid(azimuth, elevation))
    ray = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    with np.errstate(divide="ignore"):
        distance = _HEIGHT / np.where(gradient * ray[:, 0] > ray[:, 2], gradient * ray[:, 0] - ray[:, 2], 0)
    for box in boxes:
        distance = np.minimum(distance, _hit(ray, box, ground=gradient * box.x - _HEIGHT))
    seen = distance < 80
    return ray[seen] * distance[seen, None]


def _hit(ray: NDArray[np.float64], box: _Box, *, ground: float) -> NDArray[np.float64]:
    """Distance (n,) to an upright box by the slab method."""
    turn = np.array([[np.cos(box.yaw), np.sin(box.yaw)], [-np.sin(box.yaw), np.cos(box.yaw)]])
    place = turn @ [box.x, box.y]
    middle = np.array([*place, ground + box.bottom + box.size[2] / 2])
    own = np.column_stack([ray[:, :2] @ turn.T, ray[:, 2]])
    with np.errstate(divide="ignore"):
        near, far = ((middle + side * np.array(box.size) / 2) / own for side in (-1, 1))
    first, last = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    return np.where((first < last) & (first > 0), first, np.inf)


def _detected(xyz: NDArray[np.float64]) -> Detections:
    return detect(SimpleNamespace(xyz=xyz))


CAR = (4.4, 1.8, 1.45)


@pytest.mark.parametrize(
    ("x", "y", "yaw"), [(8, 3, 0), (12, -4, 0.3), (-15, 2, 0.1), (25, -6, 0.2), (6, -9, 1.4)]
)
def test_a_car_is_found_where_it_is(x: float, y: float, yaw: float) -> None:
    found = _detected(_cloud(_Box(x, y, CAR, yaw)))
    assert found.kind.tolist() == ["vehicle"]
    assert np.hypot(*(found.centre[0, :2] - [x, y])) < 0.6
    assert abs((found.yaw[0] - yaw + np.pi / 2) % np.pi - np.pi / 2) < 0.15
    np.testing.assert_allclose(found.size[0], CAR, atol=0.6)
    assert found.points[0] > 10
    assert found.score[0] > 0.5


@pytest.mark.parametrize("gradient", [-0.08, 0.08])
def test_on_a_gradient_the_ground_is_removed(gradient: float) -> None:
    xyz = _cloud(gradient=gradient)
    assert np.quantile(np.abs(height_above_ground(xyz)), 0.99) < 0.3
    found = _detected(_cloud(_Box(14, 3, CAR), gradient=gradient))
    assert found.kind.tolist() == ["vehicle"]


@pytest.mark.parametrize("gradient", [-0.08, 0.0, 0.08])
@pytest.mark.parametrize("x", [6.5, 7.5, 9.0])
def test_a_car_that_hides_the_ground_ahead_is_not_taken_for_it(x: float, gradient: float) -> None:
    xyz = _cloud(_Box(x + 2.2, 0, CAR, bottom=0.25), gradient=gradient)
    height = xyz[:, 2] - gradient * xyz[:, 0] + _HEIGHT
    np.testing.assert_allclose(height_above_ground(xyz)[height > 0.2], height[height > 0.2], atol=0.25)
    assert _detected(xyz).kind.tolist() == ["vehicle"]


def test_the_ground_beyond_a_crest_is_followed_where_it_is_flat() -> None:
    xyz = _cloud(beams=64)
    away = np.maximum(np.hypot(*xyz[:, :2].T) - 10, 0)
    fallen = xyz - np.outer(0.06 * away, [0, 0, 1])
    near = np.hypot(*xyz[:, :2].T) < 50
    assert np.abs(height_above_ground(fallen)[near]).max() < 0.3


def test_a_road_beside_a_lower_field_is_ground_as_the_field_is() -> None:
    xyz = _cloud(beams=64)
    lower = xyz - np.outer(0.12 * np.clip(xyz[:, 1] - 2, 0, 20), [0, 0, 1])
    near = np.hypot(*xyz[:, :2].T) < 30
    assert np.quantile(np.abs(height_above_ground(lower)[near]), 0.99) < 0.3


def test_a_rear_seen_alone_is_completed_away_from_the_sensor() -> None:
    found = _detected(_cloud(_Box(15, 0, CAR)))
    assert np.hypot(*(found.centre[0, :2] - [15, 0])) < 0.5


def test_walls_poles_and_bare_ground_are_no_road_users() -> None:
    wall = _Box(20, 10, (30, 0.4, 9), bottom=0)
    house = _Box(-20, -14, (12, 9, 8), 0.4, bottom=0)
    pole = _Box(9, -4, (0.2, 0.2, 6), bottom=0)
    assert len(_detected(_cloud(wall, house, pole))) == 0
    assert len(_detected(_cloud())) == 0


def test_pieces_of_a_wall_between_its_openings_are_no_trucks() -> None:
    pieces = [_Box(x, 9, (4.0, 0.3, 9), bottom=0) for x in range(-13, 15, 5)]
    assert _detected(_cloud(*pieces, beams=64, lowest=-25, highest=2)).score.max(initial=0) < 0.2
    truck = _Box(18, -6, (8.0, 2.5, 3.4), bottom=0.3)
    found = _detected(_cloud(*pieces, truck, beams=64, lowest=-25, highest=2))
    assert found.kind[0] == "vehicle"
    assert found.score[0] > 0.3
    assert np.hypot(*(found.centre[0, :2] - [18, -6])) < 1.5


def test_kinds_are_told_apart() -> None:
    person, bus = _Box(8, -3, (0.5, 0.5, 1.75), bottom=0), _Box(18, 6, (11.5, 2.5, 3.0), bottom=0.3)
    cyclist = _Box(9, 3.5, (1.75, 0.6, 1.75), bottom=0)
    found = _detected(_cloud(person, bus, cyclist))
    at = {
        str(kind): tuple(np.round(centre[:2])) for kind, centre in zip(found.kind, found.centre, strict=True)
    }
    assert set(at) == {"person", "vehicle", "cycle"}
    assert at["person"] == (8, -3)


def test_a_tree_over_a_car_does_not_hide_it() -> None:
    crown = _Box(12, 5, (4, 4, 3), bottom=3.8)
    assert "vehicle" in _detected(_cloud(_Box(12, 5, CAR), crown, beams=64)).kind


def test_the_order_of_points_does_not_matter_and_returns_that_are_none_are_left_out() -> None:
    xyz = _cloud(_Box(12, -4, CAR, 0.3), _Box(-9, 3, CAR))
    found = _detected(xyz)
    mixed = np.random.default_rng(0).permutation(np.vstack([xyz, [[np.nan] * 3, [0, 0, 0]]]))
    again = _detected(mixed)
    assert len(found) == 2
    for name, column in found.columns().items():
        if name == "kind":
            assert column.tolist() == again.kind.tolist()
        else:
            np.testing.assert_allclose(column, getattr(again, name))


def test_an_empty_cloud_has_no_road_users() -> None:
    found = _detected(np.empty((0, 3)))
    assert len(found) == 0
    assert found.box_of(np.zeros((2, 3))).tolist() == [-1, -1]


def test_returns_are_given_to_the_best_box() -> None:
    xyz = _cloud(_Box(12, -4, CAR, 0.3))
    found = _detected(xyz)
    row = found.box_of(xyz, margin=0.1)
    assert np.count_nonzero(row == 0) >= found.points[0]
    assert row[np.hypot(*(xyz[:, :2] - [12, -4]).T) > 4].max() == -1
