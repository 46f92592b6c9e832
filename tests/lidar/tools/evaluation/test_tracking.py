"""Measures of tracks, by hand."""

import numpy as np
import pytest

from lidar.errors import FormatError
from lidar.tools.evaluation.kitti_detection import labels_of
from lidar.tools.evaluation.tracking import ObjectTracks, read_tracks, score_tracks, steps_of


def at(*rows):
    """Tracks of a frame: (track, left, kind), 100 pixels wide and tall."""
    lines = [
        f"{kind} 0 0 0 {left} 100 {left + 100} 200 1.5 2 4 {left / 50} 1.5 20 0" for _, left, kind in rows
    ]
    return ObjectTracks(np.array([track for track, *_ in rows], np.int64), labels_of(lines, name="test"))


def score(true, found, *, kind="Car", measure="2d", frames=10):
    return score_tracks(
        steps_of(true, found, frames=range(frames), kind=kind, measure=measure), kind=kind, measure=measure
    )


def test_the_truth_has_no_errors():
    true = {k: at((1, 10 * k, "Car"), (2, 600 - 10 * k, "Car")) for k in range(10)}
    for measure in ("2d", "3d"):
        found = score(true, true, measure=measure)
        assert (found.mota, found.idf1, found.switches) == (1.0, 1.0, 0)
        assert found.motp == pytest.approx(1.0)
        assert found.objects == 20


def test_a_switch_a_miss_and_a_wrong_box_cost_one_each():
    """Frames 0 to 4 are track 7, frame 5 is missed, 6 to 9 are track 8, and one box is on nothing."""
    true = {k: at((1, 10 * k, "Car")) for k in range(10)}
    found = {k: at((7 if k < 5 else 8, 10 * k, "Car")) for k in range(10) if k != 5}
    found[3] = at((7, 30, "Car"), (9, 900, "Car"))
    result = score(true, found)
    assert (result.missed, result.wrong, result.switches) == (1, 1, 1)
    assert result.mota == pytest.approx(1 - 3 / 10)
    assert result.idf1 == pytest.approx(2 * 5 / (10 + 10))


def test_tracks_that_cross_keep_their_partners():
    """Where two boxes overlap both, the partner of the frame before is kept."""
    true = {0: at((1, 0, "Car"), (2, 200, "Car")), 1: at((1, 90, "Car"), (2, 110, "Car"))}
    found = {0: at((7, 0, "Car"), (8, 200, "Car")), 1: at((8, 92, "Car"), (7, 108, "Car"))}
    result = score(true, found, frames=2)
    assert (result.switches, result.missed, result.wrong) == (0, 0, 0)


def test_vans_are_neither_missed_nor_wrong_cars():
    true = {0: at((1, 0, "Van"), (2, 400, "Car"))}
    result = score(true, {0: at((5, 0, "Car"), (6, 400, "Car"))}, frames=1)
    assert (result.objects, result.missed, result.wrong) == (1, 0, 0)
    assert score(true, {0: at((6, 400, "Car"))}, frames=1).missed == 0
    assert score(true, {0: at((6, 400, "Pedestrian"))}, frames=1).missed == 1


def test_a_van_beside_the_cars_adds_nothing_to_idf1():
    """One track covers a car in each of two frames, and the same van beside both."""
    true = {k: at((k, 0, "Car"), (9, 20, "Van")) for k in range(2)}
    result = score(true, {k: at((5, 4, "Car")) for k in range(2)}, frames=2)
    assert result.idf1 == pytest.approx(2 * 1 / (2 + 2))


def test_files_of_kitti_and_of_mot_hold_the_same_tracks(tmp_path):
    line = "Car 0 0 0 100 100 200 250 1.5 2 4 1 1.5 20 0"
    (tmp_path / "k.txt").write_text(f"0 5 {line} 0.9\n2 5 {line} 0.8\n")
    (tmp_path / "m.txt").write_text("1,5,101,101,100,150,0.9,-1,-1,-1\n3,5,101,101,100,150,0.8,-1,-1,-1\n")
    (kitti, one), (mot, other) = (read_tracks(tmp_path / name) for name in ("k.txt", "m.txt"))
    assert (one, other) == ("kitti", "mot")
    assert list(kitti) == list(mot) == [0, 2]
    for frame in kitti:
        np.testing.assert_array_equal(kitti[frame].track, mot[frame].track)
        np.testing.assert_allclose(kitti[frame].labels.box, mot[frame].labels.box)
        np.testing.assert_array_equal(kitti[frame].labels.score, mot[frame].labels.score)


@pytest.mark.parametrize("text", ["0 5 Car 0 0\n", "1,2,3\n", "x 5 " + "1 " * 15 + "\n"])
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(FormatError, match=r"no tracks|no labels"):
        read_tracks(tmp_path / "t.txt")
