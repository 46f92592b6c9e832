"""Subject helios: HELIOS++, another simulator, on the same scene with the same pulses as near as it can.

HELIOS++ (2.x) is a program given by path. It reads the scene as OBJ, and a scanner, a platform, a trajectory
and a survey written here: the same elevations, pulses per second, revolutions, beam and positions. What stays
different: its scanner is level and starts at another azimuth, all channels fire at once, it knows no
instances (trees are copied into the OBJ), and its LAS has no CRS.
"""

from __future__ import annotations

import functools
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import laspy
import numpy as np

from bench.measure import BenchError, Case, Spent, command, difference
from bench.scenes import Setup, rig_file
from geoscene.export.triangles import write_obj
from lidar.sensors.rig.devices import Scanner
from lidar.sensors.rig.scanner import firings
from lidar.simulation.plan import DrivePlan

_QUALITY = {1: 1, 7: 2, 19: 3, 61: 5}
"""HELIOS++'s beamSampleQuality by rays per pulse."""

_KNOT_NS = 10_000_000
_ALIKE = 0.2
"""Greatest difference between the numbers of points, relative: more is other work."""

_NOTE = (
    "whole processes on two threads, from the scene's files to LAS, with loading; the same surfaces (--relief"
    " off; as OBJ for HELIOS++) and as near as it can the same pulses; relief: with the windows, doors and"
    " rough ground that drives have by default and HELIOS++ has not. HELIOS++: level scanner, other azimuth"
    " of the first pulse, copies instead of instances, no CRS"
)
_LOOP_NOTE = (
    "spans of time: a longer drive less a shorter one, both whole processes: without start and loading"
)

_WHOLE = ((1, 2.0), (1, 20.0), (19, 1.0))
"""Rays per pulse and seconds of drives that are measured whole, in whole runs."""

_LOOPS = ((1, 5.0, 20.0), (19, 0.5, 2.0))
"""Rays per pulse and seconds of the shorter and the longer drive whose difference is measured."""


def peer(setup: Setup) -> Iterator[Case]:
    """Drives of a VLP-16 by both programs, whole and without start; none without the program."""
    if setup.helios is None:
        return
    write_obj(setup.scene, setup.folder / "helios.obj")
    _Drive(setup, 7, 0.5).ours()  # fills the cache of compiled code, which the first process would wait for
    for rays, seconds in ((1, 2.0),) if setup.quick else _WHOLE:
        drive = _Drive(setup, rays, seconds)
        drive.write()
        yield _case(drive, f"{seconds:g} s", dict(drive.sides()), note=_NOTE)
    for rays, short, long in () if setup.quick else _LOOPS:
        less, more = _Drive(setup, rays, short), _Drive(setup, rays, long)
        less.write()
        more.write()
        pairs = zip(less.sides(), more.sides(), strict=True)
        sides = {side: partial(difference, shorter, longer) for (side, shorter), (_, longer) in pairs}
        yield _case(more, f"{short:g} to {long:g} s", sides, note=_LOOP_NOTE, less=less)


def _case(
    drive: _Drive, span: str, sides: dict[str, Callable[[], object]], *, note: str, less: _Drive | None = None
) -> Case:
    """The case of a drive, or of what it has more than a shorter one."""
    pulses, seconds = drive.extent
    if less is not None:
        pulses, seconds = pulses - less.extent[0], seconds - less.extent[1]
    return Case(
        "helios",
        f"VLP-16, {drive.setup.town}, {span}, {drive.rays} ray{'s'[: drive.rays > 1]} per pulse",
        pulses / 1e6,
        "M pulses",
        sides,
        note,
        clock="wall",
        simulated_s=seconds,
        processes=True,
    )


@dataclass(frozen=True)
class _Drive:
    """A drive that both programs do, with files of its own.

    rays    : per pulse
    seconds : simulated
    """

    setup: Setup
    rays: int
    seconds: float

    @functools.cached_property
    def plan(self) -> DrivePlan:
        """The drive as planned."""
        return self.setup.plan("VLP-16", seconds=self.seconds)

    @functools.cached_property
    def extent(self) -> tuple[int, float]:
        """Pulses, and seconds of simulated time."""
        (scanner,) = self.plan.sensors
        pulses = sum(len(firings(scanner.sensor, k)) for k in range(self.plan.frames[scanner.name]))
        return pulses, self.plan.trajectory.duration_ns / 1e9

    @functools.cached_property
    def folder(self) -> Path:
        """Of its files."""
        found = self.setup.folder / f"helios_{self.rays}_rays_{self.seconds:g}_s"
        found.mkdir(exist_ok=True)
        return found

    def write(self) -> None:
        """Write what HELIOS++ reads beside the scene as OBJ."""
        write_survey(self.plan, self.setup.folder / "helios.obj", rays=self.rays, folder=self.folder)

    def sides(self) -> Iterator[tuple[str, Callable[[], Spent]]]:
        """The programs by name."""
        yield "lidar", self.ours
        yield "lidar, relief", partial(self.ours, relief="scene")
        yield "HELIOS++", self.theirs

    def ours(self, *, relief: str = "off") -> Spent:
        """Cost of this program."""
        setup = self.setup
        words = [sys.executable, "-m", "lidar", "drive", str(setup.scene.path), "--route", "random"]
        words += ["--seed", "2", "--rig", str(rig_file("VLP-16", setup.folder))]
        words += ["--duration", str(self.seconds), "--format", "las", "--set", f"rays={self.rays}"]
        words += ["--relief", relief, "--workers", "2", "--out", str(self.folder / f"ours_{relief}")]
        words += ["--overwrite", "--quiet"]
        return command(words)

    def theirs(self) -> Spent:
        """Cost of HELIOS++; raises BenchError if it fails or did not do the same work."""
        program = self.setup.helios
        assert program is not None  # noqa: S101
        out, log = self.folder / "theirs", self.folder / "helios.log"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        words = [str(program.resolve()), str(self.folder / "helios_survey.xml"), "--output", str(out)]
        words += ["--assets", str(self.setup.folder), "--lasOutput", "--seed", "1", "--nthreads", "2"]
        words += ["--rebuildScene"]
        with log.open("w+b") as said:
            try:
                cost = command(words, errors=said, cwd=_root_of(program.resolve()))
            except subprocess.CalledProcessError as error:
                said.seek(0)
                tail = " ".join(said.read().decode(errors="replace").split())[-300:]
                raise BenchError(f"{program} ended with {error.returncode}: {tail}") from error
        ours, theirs = points(self.folder / "ours_off"), points(out)
        if abs(theirs - ours) > _ALIKE * ours:
            raise BenchError(
                f"{program} wrote {theirs} points, lidar {ours}: not the same work; see the program's log"
            )
        return cost


def version(program: Path) -> str:
    """What the program says of its version, in one line."""
    said = subprocess.run([program.resolve(), "--version"], capture_output=True, text=True, check=False)
    return " ".join(said.stdout.split())[:80] or "of unknown version"


def _root_of(program: Path) -> Path:
    """The folder that the program is run in: the first one above it with its data, or its own."""
    return next((folder for folder in program.parents if (folder / "data").is_dir()), program.parent)


def points(folder: Path) -> int:
    """Number of points of all LAS files in a folder."""
    count = 0
    for path in folder.rglob("*.las"):
        with laspy.open(path) as file:
            count += file.header.point_count
    return count


def write_survey(plan: DrivePlan, obj: Path, *, rays: int, folder: Path) -> None:
    """Write scene, scanner, platform, trajectory and survey of a drive in an OBJ into a folder."""
    (scanner,) = plan.sensors
    files = {name: folder / f"helios_{name}.xml" for name in ("scene", "scanner", "platform", "survey")}
    files["scene"].write_text(_scene_xml(obj))
    rate = _write_scanner(files["scanner"], scanner, rays=rays)
    files["platform"].write_text(_PLATFORM)
    track = folder / "helios.trj"
    _write_track(track, plan, scanner)
    seconds = plan.trajectory.duration_ns / 1e9
    turn = 360.0 * scanner.sensor.rate_hz
    files["survey"].write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document>
  <scannerSettings id="settings" active="true" pulseFreq_hz="{rate}" scanFreq_hz="0"
    headRotatePerSec_deg="{turn:g}" headRotateStart_deg="0" headRotateStop_deg="{turn * seconds:g}"
    trajectoryTimeInterval_s="0.01"/>
  <survey name="bench" scene="{files["scene"]}#bench" platform="interpolated"
    basePlatform="{files["platform"]}#bench" scanner="{files["scanner"]}#bench">
    <FWFSettings beamSampleQuality="{_QUALITY[rays]}"/>
    <leg>
      <platformSettings trajectory="{track}" tIndex="0" rollIndex="1" pitchIndex="2" yawIndex="3"
        xIndex="4" yIndex="5" zIndex="6" slopeFilterThreshold="0.0" toRadians="true" syncGPSTime="false"/>
      <scannerSettings template="settings"/>
    </leg>
  </survey>
</document>
"""
    )


def _scene_xml(obj: Path) -> str:
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document>
  <scene id="bench" name="bench">
    <part>
      <filter type="objloader">
        <param type="string" key="filepath" value="{obj}"/>
        <param type="string" key="up" value="z"/>
      </filter>
    </part>
  </scene>
</document>
"""


_PLATFORM = """<?xml version="1.0" encoding="UTF-8"?>
<document>
  <platform id="bench" name="bench" type="linearpath">
    <scannerMount x="0" y="0" z="0"/>
  </platform>
</document>
"""


def _write_scanner(path: Path, scanner: Scanner, *, rays: int) -> int:
    """Write the scanner with all channels; returns pulses per second of a channel."""
    sensor, fired = scanner.sensor, firings(scanner.sensor, 0)
    height = np.degrees(np.arcsin(fired.direction[:, 2]))
    channels = np.unique(fired.channel)
    rate = round(len(fired) / len(channels) * sensor.rate_hz)
    quality = f'<FWFSettings beamSampleQuality="{_QUALITY[rays]}"/>'
    beams = "\n".join(
        f'      <channel id="{k}">{quality}<beamOrigin x="0" y="0" z="0">'
        f'<rot axis="x" angle_deg="{height[fired.channel == channel].mean():.4f}"/></beamOrigin></channel>'
        for k, channel in enumerate(channels)
    )
    path.write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document>
  <scanner id="bench" name="bench" accuracy_m="0" beamDivergence_rad="{max(sensor.divergence):g}"
    optics="rotating" pulseFreqs_Hz="{rate}" pulseLength_ns="4" rangeMin_m="{sensor.min_range:g}"
    rangeMax_m="{sensor.max_range:g}" scanAngleMax_deg="1" scanAngleEffectiveMax_deg="1" scanFreqMin_Hz="0"
    scanFreqMax_Hz="0" wavelength_nm="903" maxNOR="1" headRotatePerSecMax_deg="{720 * sensor.rate_hz:g}">
    {quality}
    <channels>
{beams}
    </channels>
  </scanner>
</document>
"""
    )
    return rate


def _write_track(path: Path, plan: DrivePlan, scanner: Scanner) -> None:
    """Write the scanner's positions, level and without yaw, ten milliseconds apart."""
    times = np.arange(0, plan.trajectory.duration_ns + _KNOT_NS, _KNOT_NS)
    mount = scanner.spec.mount
    position = plan.trajectory.at(times).mounted(mount.translation, mount.rotation).position
    table = np.column_stack([times / 1e9, np.zeros((len(times), 3)), position])
    head = 'TIME_COLUMN: 0\n#HEADER: "t", "roll", "pitch", "yaw", "x", "y", "z"'
    np.savetxt(path, table, fmt="%.6f", delimiter=", ", header=head, comments="#")
