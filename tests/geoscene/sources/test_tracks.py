"""Routes and recorded tracks from GPX and GeoJSON files."""

import numpy as np
import pytest

from geoscene.errors import InputError, SourceNotFoundError
from geoscene.sources.tracks import read_track


def test_tracks_come_before_routes_and_waypoints_and_heights_are_read(tmp_path):
    path = tmp_path / "a.gpx"
    path.write_text(
        "<gpx xmlns='http://www.topografix.com/GPX/1/1'><wpt lat='1' lon='2'/>"
        "<trk><trkseg><trkpt lat='3' lon='4'><ele>5.5</ele></trkpt>"
        "<trkpt lat='6' lon='7'/></trkseg></trk></gpx>"
    )
    np.testing.assert_array_equal(read_track(path), [[4, 3, 5.5], [7, 6, 0]])


def test_files_without_tracks_are_refused(tmp_path):
    path = tmp_path / "a.gpx"
    with pytest.raises(SourceNotFoundError, match="does not exist"):
        read_track(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="neither GPX"):
        read_track(path)
    path.write_text("<gpx/>")
    assert read_track(path).shape == (0, 3)
