"""What the map tools load: no simulation, no ray casting, no rendering, no odometry."""

import json
import pkgutil
import subprocess
import sys

import pytest

import lidar.dataset
import lidar.tools.maps

MAPS = [module.name for module in pkgutil.walk_packages(lidar.tools.maps.__path__, "lidar.tools.maps.")]
READERS = [module.name for module in pkgutil.walk_packages(lidar.dataset.__path__, "lidar.dataset.")]
SIMULATION = (
    *("lidar.simulation", "lidar.signal", "lidar.traffic", "lidar.motion", "lidar.world", "lidar.raycast"),
    *("lidar.sensors.camera", "lidar.sensors.laser.scan", "lidar.sensors.physics.echoes", "embreex"),
)


@pytest.mark.parametrize(
    ("modules", "forbidden", "most"),
    [
        pytest.param(MAPS, (*SIMULATION, "lidar.tools.odometry", "lidar.sensors.navigation"), 70, id="maps"),
        pytest.param(READERS, SIMULATION, 100, id="dataset"),
    ],
)
def test_reading_and_mapping_load_nothing_that_simulates(modules, forbidden, most):
    """All modules of a folder together load none of the forbidden ones, and few others."""
    code = "import importlib, json, sys; [importlib.import_module(name) for name in sys.argv[1:]]"
    command = [sys.executable, "-c", f"{code}; print(json.dumps(list(sys.modules)))", *modules]
    loaded = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    found = [name for name in loaded if f"{name}.".startswith(tuple(f"{start}." for start in forbidden))]
    assert not found
    assert set(modules) <= set(loaded)
    own = [name for name in loaded if name.split(".")[0] == "lidar"]
    assert len(own) <= most, f"{len(own)} modules of lidar: {', '.join(own)}"
