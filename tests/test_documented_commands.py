"""The commands in the README, the documentation and the help texts are parsed and do what they say.

They run one after the other in a folder with the files that they name, each once, unless a later one needs
what it writes. Those for map servers, and those that serve or open a window, are only parsed. The bundled map
is replaced by a part of it, drives end after 0.2 s and have no relief unless they ask for it, surveys record
20 frames, and cameras have a sixteenth of their pixels. Sweeps have drives of 0.1 s with one seed.
"""

import csv
import json
import re
import shlex
import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from textwrap import dedent

import numpy as np
import osmium
import pytest
from helpers import ROOT
from helpers.clouds import write_survey
from helpers.overture import overture_row, write_overture
from helpers.programs import run_process, run_program
from helpers.rasters import write_slope
from helpers.samples import measure_little

import geoscene.cli
import geoscene.sources
import geoscene.tradeoff.engine
import lidar.cli
import lidar.sensors.rig.specs
import lidar.simulation.drive
import lidar.simulation.frames
import lidar.tools.tradeoff.compare
import lidar.tools.tradeoff.pick
import lidar.tools.tradeoff.search
import lidar.tools.tradeoff.sensors
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.roadgraph.routing import nearest_edge
from geoscene.sources import demo_path, read_osm
from lidar.dataset.layout import open_dataset
from lidar.motion.random_route import public_streets
from lidar.motion.road_drive import road_surface
from lidar.options.drive import DriveOptions
from lidar.tools.tradeoff.bench import coarse
from lidar.traffic.options import TrafficOptions

APPS = {"geoscene": geoscene.cli.app, "lidar": lidar.cli.app}
ONLY_PARSED = {
    "--place",
    "--point",
    "--scheduler",
    "tiles",
    "--serve",
    "--open3d",
    "--poses",
    "--live",
    "--device",
}
ONLY_PARSED |= {"evaluate", "detect", "image", "stereo", "fused"}  # they need estimates, or other sensors
BOX = (24.9400, 60.1653, 24.9420, 60.1666)
RIG = """
name = "mine"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
"""
ROUTE = """<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="60.1662" lon="24.9413"/><trkpt lat="60.1655" lon="24.9405"/></trkseg></trk></gpx>"""
PRIVATE_KEY = """-----BEGIN PRIVATE KEY-----
MC4CAQAwBQYDK2VwBCIEIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f
-----END PRIVATE KEY-----
"""
PUBLIC_KEY = """-----BEGIN PUBLIC KEY-----
MCowBQYDK2VwAyEAA6EHv/POEL4dcN0Y50vAmWfk1jCbpQ1fHdyGZBJVMbg=
-----END PUBLIC KEY-----
"""
CAR = '<vehicle id="a" x="24.9413" y="60.1662" angle="0" type="car" lane="1_0" pos="1"/>'
SECONDS = "".join(f'<timestep time="{second}">{CAR}</timestep>' for second in (300, 301))
TRAFFIC = f"<fcd-export>{SECONDS}</fcd-export>"


def commands(text):
    """Commands (words) in a text, one to a line or separated by semicolons, without comments."""
    for line in text.splitlines():
        lexer = shlex.shlex(line.strip(), posix=True, punctuation_chars=";")
        lexer.whitespace_split = True
        words = []
        if line.strip().startswith(("geoscene ", "lidar ")):
            words = list(lexer)
        while words:
            end = words.index(";") if ";" in words else len(words)
            if words[1] in APPS[words[0]]:
                yield words[:end]
            words = words[end + 1 :]


def in_page(name):
    """The commands in the blocks of code of a page; lines with brackets show a syntax."""
    blocks = (ROOT / name).read_text("utf-8").split("```")[1::2]
    return [words for block in blocks for words in commands(block) if "[" not in " ".join(words)]


def in_help(name):
    """The commands in the help texts of a program: paragraphs of their own."""
    texts = [APPS[name].help, *(APPS[name][word].help for word in APPS[name] if not word.startswith("-"))]
    paragraphs = [part.strip() for text in texts for part in (text or "").split("\n\n")]
    return [words for text in paragraphs for words in commands(text)]


PAGES = [str(path.relative_to(ROOT)) for path in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])]
SUCCEEDED: set[str] = set()
"""Commands that were run, with all options; repeated only where a later one needs what they write."""
SOURCES = [page for page in PAGES if in_page(page)] + ["geoscene --help", "lidar --help"]


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    """A folder with the input files of all examples that are text."""
    folder = tmp_path_factory.mktemp("texts") / "texts"
    reference = ROOT / "docs" / "reference"
    pages = [(reference / f"{name}.md").read_text("utf-8") for name in ("stages", "sweeps", "security")]
    stages, sweep, matrix = (page.split("```toml")[1].split("```")[0] for page in pages)
    other = (ROOT / "docs" / "howto" / "compare-sensors.md").read_text("utf-8").split("```toml")[1]
    texts = {
        "track.gpx": ROUTE,
        "my_rig.toml": RIG,
        "xt32_rig.toml": dedent(other.split("```")[0]),
        "fcd.xml": TRAFFIC,
        "stages.toml": stages,
    }
    texts |= {"sweep.toml": brief(sweep), "matrix.toml": brief(matrix)}
    texts |= {"secret.key": "00" * 32, "private.pem": PRIVATE_KEY, "public.pem": PUBLIC_KEY}
    shutil.copytree(ROOT / "examples", folder / "examples")
    texts["examples/redteam.toml"] = brief((folder / "examples" / "redteam.toml").read_text("utf-8"))
    for name, text in texts.items():
        (folder / name).write_text(text, "utf-8")
    return folder


@pytest.fixture(scope="module")
def inputs(texts, tmp_path_factory):
    """A folder with the input files of all examples."""
    folder = shutil.copytree(texts, tmp_path_factory.mktemp("inputs") / "inputs")
    city = folder / "city.osm.pbf"
    with osmium.BackReferenceWriter(str(city), str(demo_path()), overwrite=True) as writer:
        for item in osmium.FileProcessor(demo_path()).with_locations():
            if item.is_way() and any(inside(BOX, node) for node in item.nodes):
                writer.add(item)
    osm = read_osm(city, bounds=BOX)
    rows = [overture_row(area) for area in osm.areas if "building" in area.tags]
    write_overture(folder / "buildings.parquet", rows)
    write_slope(folder / "heights.tif", BOX, rise=0.3)
    write_survey(folder / "survey.laz", BOX)
    for name in ("scene", "city"):
        scene = build(osm, folder / name)
    options = DriveOptions(rig=str(folder / "my_rig.toml"), duration=0.2, formats=("kitti",))
    recorded = lidar.simulation.drive.drive(scene, folder / "recorded", options=options).path / "top"
    shutil.copytree(recorded, folder / "kitti" / "sequences" / "00")
    traffic = TrafficOptions(vehicles=60.0, parked=1.0)
    options = replace(options, duration=1.0, formats=("pcd",), route="random", traffic=traffic)
    trained = lidar.simulation.drive.drive(scene, folder / "drive1", options=options).path
    for name in ("drive", "drive2", "drive3"):
        shutil.copytree(trained, folder / name)
    return folder


@pytest.fixture
def folder(inputs, tmp_path, monkeypatch):
    """A folder with copies of the input files; drives that are run here are short."""
    folder = tmp_path / "work"
    shutil.copytree(inputs, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(geoscene.sources, "demo_path", lambda: folder / "city.osm.pbf")
    drive, record_all = lidar.simulation.drive.drive, lidar.simulation.drive.record_all

    def short(scene, out, *, options, **more):
        relief = "" if "relief" in dict(options.settings) else "off"  # images take half the time
        options = options if options.survey else replace(options, duration=0.2, relief=relief)
        return drive(scene, out, options=options, **more)

    def first(plan, jobs, **more):
        record_all(plan, jobs[:20], **more)

    compare = lidar.tools.tradeoff.compare.compare_settings

    def small(scene, options, *, compared, **more):
        compared = replace(compared, frames=2, pulses=100, pixels=256, reference_rays=7)
        return compare(scene, replace(options, duration=0.4), compared=compared, **more)

    builds = geoscene.tradeoff.engine.tradeoff
    monkeypatch.setattr(
        geoscene.tradeoff.engine,
        "tradeoff",
        lambda *args, **more: builds(*args, **more | {"settings": ("lod",)}),
    )
    plan, peaks = lidar.tools.tradeoff.search.plan_drive, lidar.tools.tradeoff.sensors.peaks
    camera = lidar.sensors.rig.specs._camera
    monkeypatch.setattr(
        lidar.tools.tradeoff.search,
        "plan_drive",
        lambda scene, options, **more: plan(scene, replace(options, duration=0.2), **more),
    )
    rays = tuple(("rays", n, float(n)) for n in (1, 7, 19, 127))  # as many as those of the small reference
    monkeypatch.setattr(lidar.tools.tradeoff.pick, "SCANNERS", rays)
    # each takes a process: one stands for all
    monkeypatch.setattr(
        lidar.tools.tradeoff.sensors,
        "peaks",
        lambda *of, variants: peaks(*of, variants=variants[:1]) * len(variants),
    )
    monkeypatch.setattr(lidar.sensors.rig.specs, "_camera", lambda table: coarse(camera(table), 4))
    measure_little(monkeypatch)
    monkeypatch.setattr(lidar.tools.tradeoff.compare, "compare_settings", small)
    monkeypatch.setattr(lidar.simulation.drive, "drive", short)
    monkeypatch.setattr(lidar.simulation.drive, "record_all", first)
    return folder


def is_only_parsed(words):
    return bool(ONLY_PARSED & set(words) or re.search("sumo|s3://", " ".join(words)))


def read_by(command):
    """Files and folders of the current folder that a command may read."""
    _, _, *words = command
    written = words.index("-o") + 1 if "-o" in words else None
    words = [word for k, word in enumerate(words) if k != written]
    return [] if is_only_parsed(words) else [word.split("/")[0] for word in words]


def brief(grid):
    """A file of a sweep or a matrix with drives of 0.1 s and one seed."""
    grid, durations = re.subn(r"duration = \d+", "duration = 0.1", grid)
    grid, seeds = re.subn(r"seed = \[.*\]", "seed = [1]", grid)
    assert durations == seeds == 1
    return grid


def inside(box, node):
    return node.location.valid() and box[0] < node.lon < box[2] and box[1] < node.lat < box[3]


def commands_of(source):
    return in_help(source.split()[0]) if source.endswith("--help") else in_page(source)


@pytest.mark.gate
@pytest.mark.parametrize("source", SOURCES)
def test_documented_commands_are_parsed(source, texts, monkeypatch):
    monkeypatch.chdir(texts)
    for program, *words in commands_of(source):
        APPS[program].parse_args(words, exit_on_error=False, print_error=False)


@pytest.mark.parametrize("source", SOURCES)
def test_documented_commands_succeed(source, folder):
    found = commands_of(source)
    for number, (program, *words) in enumerate(found):
        _, bound, _ = APPS[program].parse_args(words, exit_on_error=False, print_error=False)
        if is_only_parsed(words):
            continue
        bound.apply_defaults()
        named = f"{program} {words[0]} {bound}"
        out = words[words.index("-o") + 1] if "-o" in words else ""
        later = [word for command in found[number + 1 :] for word in read_by(command)]
        if named in SUCCEEDED and out not in later:
            continue
        if words[0] in ("build", "drive"):
            shutil.rmtree(folder / words[words.index("-o") + 1], ignore_errors=True)
        if words[0] == "drive" and words[1].endswith(".osm.pbf"):
            words += ["--scene-cache", "scenes"]
        if words[0] == "build" and "--demo" in words:  # runs in another process
            words += ["--bbox", ",".join(map(str, BOX))]
        (folder / "map.laz").unlink(missing_ok=True)
        # they fork workers: from a process of their own, as users run them, not one with others' threads
        run = run_process if words[0] in ("build", "redteam", "sweep") else run_program
        done = run(program, *words, cwd=folder)
        assert done.returncode == 0, (program, words, done.stderr)
        SUCCEEDED.add(named)


@pytest.mark.parametrize("page", ["README.md", "docs/guide/python.md"])
def test_examples_in_python_succeed(page, folder, monkeypatch):
    """The blocks of a page, one after the other; simulated drives are as short as recorded ones."""
    examples = [part.split("```")[0] for part in (ROOT / page).read_text("utf-8").split("```python")[1:]]
    assert examples
    for name in ("scene", "drive"):  # the examples write them
        shutil.rmtree(folder / name)
    monkeypatch.setattr(geoscene, "demo_path", geoscene.sources.demo_path)
    monkeypatch.setattr(lidar, "drive", lidar.simulation.drive.drive)
    simulate = lidar.simulation.frames.simulate
    monkeypatch.setattr(
        lidar, "simulate", lambda scene, options: simulate(scene, replace(options, duration=0.2))
    )
    names = {}
    for example in examples:
        exec(example, names)  # noqa: S102
    assert (folder / "drive" / "dataset.json").is_file()


RECEIVER = """
[[gnss]]
name = "gnss"
translation = [0.6, 0.0, 1.6]
rate_hz = 10.0
"""


@pytest.fixture(scope="module")
def first_drive(tmp_path_factory):
    """The drive of the tutorial, in the whole demo scene, and what the page does with it; without cameras."""
    folder = tmp_path_factory.mktemp("first")
    scene = build(read_osm(demo_path()), folder / "scene", options=BuildOptions(use="lidar"))
    (folder / "rig.toml").write_text(RIG + RECEIVER)
    for program, *words in in_page("docs/guide/tutorial.md"):
        if words[0] in ("apply", "defend", "map") or (words[0] == "drive" and "--traffic" in words):
            extra = ["--rig", "rig.toml"] if words[0] == "drive" else []
            done = run_program(program, *words, *extra, cwd=folder)
            assert done.returncode == 0, (words, done.stderr)
    return folder, scene


def test_the_first_drive_is_on_a_street_in_the_open(first_drive):
    folder, scene = first_drive
    data = open_dataset(folder / "drive")
    path = data.trajectory()
    assert data.manifest["length_m"] > 40.0
    speed = np.linalg.norm(path.velocity, axis=1)
    assert speed[0] > 4.0
    ground = road_surface(scene)(*path.position.T)
    assert np.abs(path.position[:, 2] - ground).max() < 0.5
    assert path.position[:, 2].min() > -2.0
    graph = scene.road_graph()
    edge, _, _ = nearest_edge(graph, path.position[:1, :2])
    assert public_streets(graph, body_width=1.8)[edge].all()


def test_the_first_drive_has_fixes_and_sees_road_users(first_drive):
    data = open_dataset(first_drive[0] / "drive")
    with (data.path / "gnss.csv").open(newline="") as file:
        fixes = [row for row in csv.DictReader(file) if int(row["quality"]) > 0]
    assert len(fixes) > 0.3 * 10 * data.manifest["duration_ns"] / 1e9  # of ten a second, between houses
    with (data.path / "boxes.csv").open(newline="") as file:
        seen = {row["id"] for row in csv.DictReader(file) if int(row["points"]) >= 10}
    assert len(seen) >= 5


def test_the_defence_of_the_tutorial_finds_its_attack(first_drive):
    judged = json.loads((first_drive[0] / "judged" / "defend.json").read_text("utf-8"))
    frames, objects = (judged["defences"]["physics"][of] for of in ("frames", "objects"))
    assert objects["attacked"] > 50
    assert objects["tpr"][0] > 0.9
    assert objects["auc"][0] > 0.98
    assert frames["tpr"][0] > 0.9
    assert frames["fpr"][0] < 0.05


def test_pages_of_the_guide_write_to_places_of_their_own():
    """What a reader made by one page is neither overwritten nor taken by another."""
    pages = [page for page in PAGES if "howto" in page or page.endswith("tutorial.md")]
    written = {
        page: {words[words.index("-o") + 1] for words in in_page(page) if "-o" in words} for page in pages
    }
    for one, other in combinations(pages, 2):
        assert not written[one] & written[other], (one, other)


@pytest.mark.parametrize(
    ("page", "file"),
    [("docs/howto/security.md", "examples/attacks/inserted_box.toml")],
)
def test_files_that_a_page_shows_are_those_of_the_repository(page, file):
    blocks = [
        dedent(block.split("```")[0]) for block in (ROOT / page).read_text("utf-8").split("```toml")[1:]
    ]
    assert Path(file).name in (ROOT / page).read_text("utf-8")
    assert (ROOT / file).read_text("utf-8").strip() in [block.strip() for block in blocks]
