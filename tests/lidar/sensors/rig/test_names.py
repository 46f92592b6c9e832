"""Names of sensors beside a dataset's own files."""

import dataclasses
from pathlib import Path

import pytest

from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import RigError
from lidar.sensors.rig.names import LONGEST, RESERVED
from lidar.sensors.rig.specs import load_rig

KINDS = {
    "lidar": '[[lidar]]\npreset = "vlp16"\n',
    "camera": "[[camera]]\nwidth = 64\nheight = 48\nfov_deg = 90.0\n",
    "gnss": "[[gnss]]\n",
    "imu": "[[imu]]\n",
}


def rig_with(folder: Path, *sensors: tuple[str, str]) -> Path:
    path = folder / "rig.toml"
    path.write_text("".join(f"{KINDS[kind]}name = {name!r}\n" for kind, name in sensors), "utf-8")
    return path


def test_reserved_are_the_files_of_datasets_that_no_sensor_has(town_drive):
    properties = [name for name, value in vars(Paths).items() if isinstance(value, property)]
    stated = {getattr(Paths(Path("drive")), name).relative_to("drive").parts[0] for name in properties}
    sensors = open_dataset(town_drive).sensors()
    found = {entry.name for entry in town_drive.iterdir() if entry.name.partition(".")[0] not in sensors}
    assert {field.name for field in dataclasses.fields(Paths)} == {"root"}
    assert found <= stated
    assert {name.partition(".")[0] for name in stated | found} | {"truth"} == RESERVED


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [*sorted(RESERVED), "Poses", "CON", "nul", "Aux", "com1", "LPT9", "COM¹"])
def test_a_name_of_a_file_or_device_is_refused(tmp_path, kind, name):
    with pytest.raises(RigError) as caught:
        load_rig(rig_with(tmp_path, (kind, name)))
    message = str(caught.value)
    assert f"{kind}.name: {name!r}: " in message
    written = message.rpartition("write ")[2].partition(",")[0]
    assert load_rig(rig_with(tmp_path, (kind, written)))  # what the message proposes is taken


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "name", ["", "top.", "a/b", "a\\\\b", "..", " ", "poses.csv", "x" * (LONGEST + 1), "é" * 200]
)
def test_a_name_that_cannot_be_a_files_is_refused_with_one_that_can(tmp_path, kind, name):
    with pytest.raises(RigError, match=f"{kind}.name") as caught:
        load_rig(rig_with(tmp_path, (kind, name)))
    assert len(str(caught.value)) < len(str(tmp_path)) + 200
    written = str(caught.value).rpartition("write ")[2].partition(",")[0]
    assert load_rig(rig_with(tmp_path, (kind, written)))


def test_the_longest_name_is_a_file_name_with_all_suffixes(tmp_path):
    name = "𠀀" * LONGEST  # four bytes each
    load_rig(rig_with(tmp_path, ("imu", name)))
    (tmp_path / f"{name}.truth.csv.{2**22}.part").write_text("")


@pytest.mark.parametrize("other", ["top", "TOP", "Top"])
@pytest.mark.parametrize("kind", KINDS)
def test_names_that_differ_in_case_only_collide(tmp_path, kind, other):
    with pytest.raises(RigError, match=r"taken by another sensor.*write \w+_2"):
        load_rig(rig_with(tmp_path, ("lidar", "top"), (kind, other)))
