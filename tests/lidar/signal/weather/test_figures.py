import io

import numpy as np
import pytest
from helpers.programs import run_program
from PIL import Image

from lidar.sensors.rig.scanner import load_sensor
from lidar.signal.weather.figures import lost_share, max_range
from lidar.signal.weather.lisa import goodin_extinction
from lidar.signal.weather.media import fog_extinction


def test_lost_shares_are_those_of_published_ranges():
    # Of a target that is seen at 100 m in clear air, at 10 mm/h.
    assert lost_share(goodin_extinction(10)) == pytest.approx(1 - 0.3013, abs=2e-4)
    assert lost_share(1.457e-3) == pytest.approx(1 - 0.8797, abs=2e-4)
    assert lost_share(0.0) == pytest.approx(0, abs=1e-6)


def test_the_maximum_range_in_clear_air_is_the_sensors():
    sensor = load_sensor("vlp16")
    assert max_range(sensor, sensor.reference_reflectance, extinction=0.0) == pytest.approx(50)
    assert max_range(sensor, 0.5, extinction=fog_extinction(50, 905)) == pytest.approx(21.4, abs=0.5)


def test_the_plot_is_a_png_of_four_panels(tmp_path):
    out = tmp_path / "weather.png"
    assert run_program("lidar", "plot", "weather", "--sensor", "vlp16", "-o", out).returncode == 0
    picture = np.asarray(Image.open(io.BytesIO(out.read_bytes())))
    rows, columns, _ = picture.shape
    for part in (picture[: rows // 2], picture[rows // 2 :]):
        for panel in (part[:, : columns // 2], part[:, columns // 2 :]):
            assert len(np.unique(panel.reshape(-1, 3), axis=0)) > 10


def test_bad_options_of_the_plot_end_with_a_line(tmp_path):
    out = tmp_path / "weather.png"
    out.write_bytes(b"")
    for words in (("-o", out), ("-o", tmp_path / "a.jpg"), ("--sensor", "vlp17", "-o", tmp_path / "a.png")):
        run = run_program("lidar", "plot", "weather", *words)
        assert run.returncode == 2
        assert run.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == [out]
