"""The benchmarks use what the packages have, and the bench measures, fits, reports and compares."""

import functools
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers import ROOT

FOLDER = ROOT / "benchmarks"

PEER = """#!{python}
import sys, xml.etree.ElementTree as ET
from pathlib import Path
import laspy, numpy as np
if sys.argv[1] == "--version":
    sys.exit(print("Stand-in 1.0"))
survey = ET.parse(sys.argv[1]).getroot()
words = survey.find("survey").attrib
def part(name, tag):
    path, _, key = words[name].partition("#")
    return next(e for e in ET.parse(path).getroot().iter(tag) if e.get("id") == key)
obj = next(p.get("value") for p in part("scene", "scene").iter("param") if p.get("key") == "filepath")
assert sum(line.startswith("f ") for line in open(obj)) > 1000
assert part("basePlatform", "platform").find("scannerMount") is not None
channels = part("scanner", "scanner").find("channels").findall("channel")
tilt = [float(c.find("beamOrigin/rot").get("angle_deg")) for c in channels]
assert sorted(round(t) for t in tilt) == list(range(-15, 16, 2))
track = np.loadtxt(survey.find("survey/leg/platformSettings").get("trajectory"), delimiter=",")
assert track.shape[1] == 7 and abs(track[-1, 0] - 2) < 0.02
rate = float(survey.find("scannerSettings").get("pulseFreq_hz"))
las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
count = int({share} * len(channels) * rate * track[-1, 0])
las.x = las.y = las.z = np.zeros(count)
las.write(Path(sys.argv[sys.argv.index("--output") + 1]) / "leg000_points.las")
"""
"""A stand-in for HELIOS++ that checks the files it is given and writes a share of the pulses as points."""


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


def run_bench(*words):
    paths = os.pathsep.join(map(str, (FOLDER, ROOT)))
    return subprocess.run(
        [sys.executable, "-m", "bench", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": paths},
    )


def error_line(done):
    """The only line on standard error."""
    (line,) = done.stderr.splitlines()
    return line


@pytest.mark.gate
@pytest.mark.parametrize(
    "name",
    sorted(
        ".".join(path.relative_to(FOLDER).with_suffix("").parts)
        for path in FOLDER.rglob("*.py")
        if not path.name.startswith("__")
    ),
)
def test_every_benchmark_can_be_imported(name, bench):
    assert bench(name).__doc__


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Folder of a quick run of all subjects on the demo."""
    out = tmp_path_factory.mktemp("bench") / "report"
    done = run_bench("--quick", "--repetitions", 1, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "HELIOS++ was not measured" in done.stdout
    return out


def test_a_quick_run_measures_every_subject_against_its_references(quick):
    document = json.loads((quick / "bench.json").read_text())
    sides = {}
    for case in document["cases"]:
        sides.setdefault(case["subject"], set()).update(case["sides"])
        assert all(side["wall_s"][0] > 0 for side in case["sides"].values())
    assert {"geoscene", "pyosmium, areas", "pyosmium, objects"} <= sides["reading a map"]
    assert {"geoscene", "numpy", "lidar", "numpy, embreex"} <= sides["reading a scene"]
    assert {"lidar", "embreex", "1 thread", "2 threads"} <= sides["casting"]
    assert {"lidar", "rays alone", "1 worker", "2 workers"} <= sides["driving"]
    assert {"lidar", "laspy", "numpy"} <= sides["writing"]
    assert {"1 worker", "2 workers"} <= sides["building"]
    assert "mapping" in sides
    sizes = {(curve["size"], curve["cost"]) for curve in document["curves"]}
    for size in ("buildings", "triangles", "rays per pulse", "frames"):
        assert {(size, "CPU s"), (size, "bytes")} <= sizes
    assert {("road users", "CPU s"), ("workers", "wall s"), ("workers", "bytes")} <= sizes
    assert document["machine"]["cores"] >= 1
    assert document["machine"]["libraries"]["numpy"] == np.__version__


def test_a_quick_run_writes_a_readable_report(quick):
    text = (quick / "bench.md").read_text()
    assert "## Casting" in text
    assert "GiB" in text
    page = (quick / "bench.html").read_text()
    assert page.count("data:image/png") > 10


def test_two_runs_on_one_machine_have_ratios(quick, tmp_path):
    done = run_bench("compare", quick / "bench.json", quick / "bench.json")
    assert done.returncode == 0
    assert "casting" in done.stdout

    document = json.loads((quick / "bench.json").read_text())
    document["machine"] |= {"machine": "0" * 16, "cpu": "another"}
    other = tmp_path / "other.json"
    other.write_text(json.dumps(document))
    done = run_bench("compare", quick / "bench.json", other)
    assert done.returncode == 2
    assert "two machines" in error_line(done)
    assert "another" in done.stderr


@pytest.mark.gate
@pytest.mark.parametrize("text", ["", "{}", "[]"])
def test_files_that_are_no_reports_are_refused(text, bench, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")  # which the bench sets, for this test alone
    path = str(tmp_path / "bench.json")
    Path(path).write_text(text)
    monkeypatch.setattr(sys, "argv", ["bench", "compare", path, path])
    assert bench("bench.__main__").main() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert path in line


@pytest.mark.gate
@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_exponents_of_known_curves(power, bench):
    rng = np.random.default_rng(1)
    x = np.repeat([1e3, 2e3, 5e3, 1e4, 3e4], 4)
    found = bench("bench.growth").exponent(x, 3.0 * x**power * np.exp(rng.normal(0, 0.05, len(x))))
    assert found.low < power < found.high
    assert found.high - found.low < 0.1
    assert found.at(1e4) == pytest.approx(3.0 * 1e4**power, rel=0.05)
    exact = bench("bench.growth").exponent([1, 10, 100], [2 * 10 ** (k * power) for k in range(3)])
    assert exact.value == pytest.approx(power, abs=1e-12)


@pytest.mark.gate
def test_curves_without_an_exponent(bench):
    exponent = bench("bench.growth").exponent
    assert exponent([1, 2, 3], [1, 0, 2]) is None
    assert exponent([2, 2], [1, 2]) is None
    two = exponent([1, 2], [8, 4])
    assert two.value == pytest.approx(-1)
    assert np.isnan(two.low)
    assert np.isnan(two.error)


@pytest.mark.gate
def test_curves_are_fitted_through_the_medians_of_their_sizes(bench):
    curve = bench("bench.growth").Curve
    x, cost = [1.0, 10.0, 100.0, 1000.0], [3.0, 40.0, 200.0, 3000.0]
    once = curve("n", "s", "CPU s", tuple(x), tuple(cost)).exponent
    often = curve("n", "s", "CPU s", (*x, *x, 1.0), (*cost, *cost, 90.0)).exponent
    assert often == once  # repetitions do not narrow the interval of a bent line
    slope, covariance = np.polyfit(np.log(x), np.log(cost), 1, cov=True)
    assert (once.value, once.error) == pytest.approx((slope[0], np.sqrt(covariance[0, 0])))
    assert once.low < once.value - 4 * once.error < once.value + 4 * once.error < once.high

    small = curve("n", "s", "bytes", (1.0, 10.0, 100.0, 1000.0), (0.0, 2.0, 20.0, 200.0))
    assert small.exponent.value == pytest.approx(1)
    assert curve("n", "s", "bytes", (1.0, 10.0, 100.0), (0.0, 2.0, 20.0)).exponent is None
    workers = curve("n", "workers", "wall s", (1.0, 2.0, 1.0, 2.0), (8.0, 4.0, 8.0, 4.4)).exponent
    assert workers.error > 0


@pytest.mark.parametrize("what", ["buildings", "triangles", "rays per pulse", "frames", "road users"])
def test_sizes_of_curves_span_two_decades(what, bench, tmp_path):
    curves, setup = bench("bench.curves"), bench("bench.scenes").Setup
    whole = curves.sizes(setup(quick=False, repetitions=1, folder=tmp_path), what)
    full = curves.sizes(setup(quick=False, repetitions=1, folder=tmp_path, full=True), what)
    assert whole[-1] >= 100 * whole[0]
    assert len(whole) >= 5
    assert full[: len(whole)] == whole
    if what == "buildings":
        assert (whole[-1], full[-1]) == (10_000, 100_000)


def test_great_sizes_are_not_repeated(bench, tmp_path):
    curves, measure = bench("bench.curves"), bench("bench.measure")
    setup = bench("bench.scenes").Setup(quick=True, repetitions=5, folder=tmp_path)
    seconds = {1: 0.5, 10: 0.6 * curves.ENOUGH_S, 100: curves.ENOUGH_S}
    x, spent = curves._processes(
        setup, {n: functools.partial(measure.Spent, 1.0, s) for n, s in seconds.items()}
    )
    assert x == (1.0, 1.0, 1.0, 10.0, 10.0, 100.0)
    assert [s.cpu_s for s in spent] == [seconds[int(n)] for n in x]


def test_builds_that_are_measured_make_all_their_tiles(bench, tmp_path, monkeypatch):
    maps = bench("bench.maps")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "tiles.json").write_text("of a former build")
    monkeypatch.setattr(maps, "command", lambda _: (tmp_path / "scene").exists())
    assert not maps.built(tmp_path / "a.osm", tmp_path / "scene", workers=1)


@pytest.mark.gate
def test_sides_take_turns_and_ratios_are_of_the_same_repetition(bench):
    measure, order = bench("bench.measure"), []

    def side(name, seconds):
        def work():
            order.append(name)
            return measure.Spent(next(seconds), 0.0)

        return work

    sides = {"a": side("a", iter([9, 1, 2])), "b": side("b", iter([9, 3, 8]))}
    case = measure.Case("s", "n", 6.0, "u", sides, clock="wall")
    found = measure.measured(case, repetitions=2)
    assert "".join(order) == "abab" + "ba"
    assert found.rate("a") == measure.Summary(4.5, 3.0, 6.0)
    assert not found.case.sides  # they hold scenes
    assert found.ratio("b") == measure.Summary(3.5, 3.0, 4.0)


def test_a_start_cancels_out_in_the_difference_of_two_drives(bench):
    measure = bench("bench.measure")
    spent = [measure.Spent(3.0 + rate * 5, 2.0 + rate * 5, 10, 5) for rate in (0.1, 0.4)]
    found = measure.difference(*(lambda s=s: s for s in spent))
    assert (found.wall_s, found.cpu_s) == pytest.approx((1.5, 1.5))
    assert found.peak_bytes == 10
    with pytest.raises(measure.BenchError, match=r"longer work took 3\.50 s, the shorter 5\.00 s"):
        measure.difference(*(lambda s=s: s for s in spent[::-1]))


def test_memory_of_processes_of_their_own(bench):
    cost = bench("bench.measure").alone(functools.partial, np.ones, 50 * 2**17)
    assert cost.peak_bytes == pytest.approx(50 * 2**20, rel=0.1)


def test_references_write_what_the_program_writes(quick_setup, bench):
    files = bench("bench.files")
    table, info = files.table_of(files.recorded(quick_setup), ".las"), files.las_info(quick_setup)
    files.FORMATS["las"].write(quick_setup.folder / "ours.las", table, info=info)
    files.laspy_written(quick_setup.folder / "theirs.las", table, info=info)
    ours, theirs = (laspy.read(quick_setup.folder / f"{name}.las") for name in ("ours", "theirs"))
    assert ours.points.array.tobytes() == theirs.points.array.tobytes()

    local = files.table_of(files.recorded(quick_setup), ".pcd")
    for name, plain in (("pcd", files.numpy_pcd), ("kitti", files.numpy_kitti)):
        one, other = quick_setup.folder / f"one.{name}", quick_setup.folder / f"other.{name}"
        files.FORMATS[name].write(one, local)
        plain(other, local)
        assert one.read_bytes() == other.read_bytes()

    files.aggregate(files.open_dataset(files.recorded(quick_setup)), quick_setup.folder / "map.las")
    files.laspy_map(files.recorded(quick_setup), quick_setup.folder / "map2.las", info=info, voxel=None)
    ours, theirs = (laspy.read(quick_setup.folder / f"{name}.las") for name in ("map", "map2"))
    assert ours.points.array.tobytes() == theirs.points.array.tobytes()


@pytest.fixture
def quick_setup(bench, tmp_path):
    return bench("bench.scenes").Setup(quick=True, repetitions=1, folder=tmp_path)


def test_casters_of_the_references_hit_the_same_surfaces(bench, tmp_path):
    casting = bench("bench.casting")
    vertices, faces = bench("bench.scenes").boxes_on_hills(4e4)
    directions, index = casting.SENSORS["VLP-16"]()
    sides = casting.casters(
        vertices,
        faces,
        loop=casting.native(tmp_path),
        poses=casting.street(1, 1800),
        index=index,
        directions=directions,
    )
    exact = sides["lidar"]()
    for name, cast in sides.items():
        ranges = cast()
        near = exact < 100
        assert np.mean(np.abs(ranges[near] - exact[near]) < 0.01) > 0.999, name


@pytest.mark.parametrize(("share", "alike"), [(0.72, True), (0.2, False)])
def test_a_peer_gets_the_same_scene_and_pulses_and_must_do_the_same_work(share, alike, tmp_path):
    program = tmp_path / "helios"
    program.write_text(PEER.format(python=sys.executable, share=share))
    program.chmod(0o755)
    out = tmp_path / "report"
    words = ["--quick", "--only", "helios", "--repetitions", 1, "--helios", program, "--out", out]
    done = run_bench(*words)
    if not alike:
        assert done.returncode == 2
        assert "not the same work" in done.stderr
        return
    assert done.returncode == 0, done.stderr
    document = json.loads((out / "bench.json").read_text())
    assert "HELIOS++ is Stand-in 1.0" in document["notes"]
    assert document["seconds"]["helios"] > 0
    (case,) = document["cases"]
    assert set(case["sides"]) == {"lidar", "lidar, relief", "HELIOS++"}
    assert case["sides"]["HELIOS++"]["ratio"] is not None


def test_a_run_is_quick_or_full():
    done = run_bench("--quick", "--full")
    assert done.returncode == 2
    assert "give one of them" in error_line(done)


def test_a_missing_peer_is_refused(tmp_path):
    done = run_bench("--only", "helios", "--helios", tmp_path / "none")
    assert done.returncode == 2
    assert f"{tmp_path / 'none'}: no such program" in error_line(done)
