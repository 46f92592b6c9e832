"""Builds the tiles of a scene in parallel, and resumes interrupted builds."""

from __future__ import annotations

import functools
import io
import json
import pickle
import secrets
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely

from geoscene.buildings import build_solids
from geoscene.buildings.facades import FacadeSetting, Layout, wall_relief
from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, ShapeInstances, concatenate
from geoscene.geometry.polylines import cross
from geoscene.geometry.watertight import validate_mesh
from geoscene.ground import ground_tile, tile_box, tile_place
from geoscene.ground.standing import standing_height
from geoscene.objects.barriers import barrier_meshes
from geoscene.objects.forests import forest_tree_count
from geoscene.objects.furniture import furniture_instances
from geoscene.objects.rooftops import roof_objects
from geoscene.objects.vegetation import tree_instances
from geoscene.objects.wires import wire_instances
from geoscene.pipeline.plan import BuildPlan, take_buildings
from geoscene.scene import SceneFiles
from geoscene.scene.tile_files import FullParts, Tile, read_tile, write_tile
from geoscene.structures import StructureOptions, built_structures
from geoscene.support.cluster import DaskCluster
from geoscene.support.digests import file_digest
from geoscene.support.files import naming, write_atomically
from geoscene.support.problems import Problem, describe_unexpected, described, make_without_failures
from geoscene.support.processes import run_tasks
from geoscene.typing import Bools, Ints

T = TypeVar("T")

_TILES = 4
"""Tiles of a task of a cluster: few, so that the tasks of a lost worker are soon repeated."""

_GREY = 128
"""Colour of faces whose colour is left out."""

_SINGULAR = {
    "trees": "tree",
    "furniture": "furniture",
    "barriers": "barrier",
    "structures": "structure",
    "wires": "wire",
}


@dataclass(frozen=True, slots=True)
class TileReport:
    """Contents of a tile.

    solids     : number of closed solids, buildings included
    watertight : number of solids that passed the check
    buildings  : number of building solids
    faces      : number of faces
    instances  : number of instances of shapes, those of forests included
    forest_trees : number of trees of forests
    area       : plan area of the ground in square metres
    water      : plan area of the water on it
    digest     : digest of the tile's file
    problems   : buildings that were simplified, and features that were dropped
    facades    : openings of walls by what they are; empty without relief
    guessed    : number of guessed parts by kind, those of buildings aside
    roofs      : what stands on roofs by shape; empty without full relief
    """

    i: int
    j: int
    solids: int
    watertight: int
    buildings: int
    faces: int
    instances: int
    forest_trees: int
    area: float
    water: float
    digest: str
    problems: tuple[Problem, ...]
    facades: dict[str, int] = field(default_factory=dict)
    guessed: dict[str, int] = field(default_factory=dict)
    roofs: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The report as a JSON object, without empty tables of relief."""
        relief = ("facades", "guessed", "roofs")
        return {name: value for name, value in asdict(self).items() if name not in relief or value}


@dataclass(frozen=True, slots=True)
class Keys:
    """Digests of the inputs of a tile's ground and solids: equal digests mean equal bytes."""

    ground: str
    solids: str


def make_solids(plan: BuildPlan, tile: tuple[int, int], *, lod: int) -> tuple[Mesh, list[Problem]]:
    """Mesh of the buildings of tile (i, j) in scene metres, and their problems."""
    i, j = tile
    parts = plan.of_tile("parts", i, j=j)
    of_parts = plan.buildings.outline[parts]
    problems: list[Problem] = []

    def solids(rows: Ints) -> tuple[Mesh, list[Problem]]:
        chosen = take_buildings(plan.buildings, rows, parts=parts[np.isin(of_parts, rows)])
        parapet = None
        if plan.rooftops is not None:
            parapet = plan.rooftops.parapet[np.concatenate([rows, parts[np.isin(of_parts, rows)]])]
        mesh, found = build_solids(
            chosen, base=plan.base[rows], foot=plan.foot[rows], lod=lod, parapet=parapet
        )
        return replace(mesh, feature=rows[mesh.feature].astype(np.int32)), found

    def failed(row: int, error: Exception) -> None:
        name = str(plan.buildings.osm_id[row])
        problems.append(Problem(name, "building", "dropped", "no-solid", described(error)))

    made = make_without_failures(solids, plan.of_tile("buildings", i, j=j), failed=failed)
    problems += [problem for _, found in made for problem in found]
    return concatenate([mesh for mesh, _ in made]), problems


@dataclass(frozen=True, slots=True)
class TileSurroundings:
    """A tile's ground, structures and objects, without its buildings.

    mesh      : ground, barriers and structures, scene metres
    instances : trees and furniture, scene metres
    equipment : (m,) bool, faces of the equipment of tunnels
    problems  : features that were dropped
    guessed   : number of guessed parts by kind
    """

    mesh: Mesh
    instances: ShapeInstances
    equipment: Bools
    problems: list[Problem]
    guessed: Counter[str]


def make_ground(plan: BuildPlan, tile: tuple[int, int]) -> TileSurroundings:
    """Build the ground, objects and structures of tile (i, j)."""
    i, j = tile
    height, problems = plan.height, list[Problem]()

    def made(table: Any, kind: str, *, make: Callable[[Ints], T]) -> list[T]:
        def failed(row: int, error: Exception) -> None:
            problems.append(describe_unexpected(str(table.osm_id[row]), error, kind=_SINGULAR[kind]))

        return make_without_failures(make, plan.of_tile(kind, i, j=j), failed=failed)

    covered = tile_place(plan.ground, i, j=j) is not None
    meshes, foot = [], standing_height(plan.ground, height)
    if covered:
        ground = ground_tile(plan.ground, i, j=j, height=height, levels=plan.levels)
        foot = standing_height(plan.ground, height, ground=ground)
        kept = ground.klass != Class.TUNNEL  # the ground is open at tunnel mouths
        meshes.append(ground if kept.all() else ground.take(kept))
    trees, furniture, barriers = plan.trees, plan.furniture, plan.barriers
    copies = [
        *made(trees, "trees", make=lambda rows: tree_instances(trees.take(rows), height=foot)),
        *made(
            furniture, "furniture", make=lambda rows: furniture_instances(furniture.take(rows), height=foot)
        ),
        *made(plan.wires, "wires", make=lambda rows: wire_instances(plan.wires.take(rows), height=foot)),
    ]
    solids = made(barriers, "barriers", make=lambda rows: barrier_meshes(barriers.take(rows), height=foot))
    meshes += [mesh for some in solids for mesh in some]
    options = StructureOptions.of_relief(plan.relief)
    structures = made(
        plan.structures,
        "structures",
        make=lambda rows: built_structures(
            plan.structures, rows, height=height, openings=plan.openings, options=options
        ),
    )
    guessed, equipment = Counter[str](), [np.zeros(sum(map(len, meshes)), np.bool_)]
    for built in (built for some in structures for built in some):
        meshes.append(built.mesh)
        equipment.append(built.equipment)
        guessed.update(built.guessed)
    instances = ShapeInstances.concatenate([ShapeInstances.empty(), *copies])
    return TileSurroundings(concatenate(meshes), instances, np.concatenate(equipment), problems, guessed)


def build_tile(
    plan: BuildPlan, folder: Path, *, tile: tuple[int, int], lod: int, former: tuple[Path, TileReport] | None
) -> TileReport:
    """Build tile (i, j), write it into ``folder`` and return a report of its contents.

    former : tile file of an earlier build whose ground is reused, and its report
    """
    size = plan.ground.tile_size
    solids, problems = make_solids(plan, tile, lod=lod)
    if former is not None:
        file, report = former
        old, guessed = read_tile(file), report.guessed
        is_building = old.mesh.closed & (old.mesh.feature < plan.buildings.count)
        origin, rest = old.origin, old.mesh.take(~is_building)
        equipment = (
            np.zeros(len(rest), np.bool_) if old.full_parts is None else old.full_parts.faces[~is_building]
        )
        of = old.instances.feature
        copies = old.instances.take((of < 0) | (of >= plan.buildings.count))  # without those on roofs
    else:
        around = make_ground(plan, tile)
        ground, copies, guessed = around.mesh, around.instances, dict(sorted(around.guessed.items()))
        equipment, problems = around.equipment, problems + around.problems
        low = float(np.floor(ground.vertices[:, 2].min(initial=0.0)))
        origin = np.array([tile[0] * size, tile[1] * size, low])
        # Without unused vertices, as when the ground is taken from a former scene.
        rest = ground.take(np.arange(len(ground))).shifted(-origin)
        copies = copies.shifted(-origin)
    on_roofs, roofs = _roof_objects(plan, solids, lod=lod, problems=problems)
    added = np.isin(copies.feature, plan.furniture.feature[plan.furniture.source != "mapped"])
    copies = ShapeInstances.concatenate([copies, on_roofs.shifted(-origin)])
    layout = None if plan.facades is None else _facades(plan, plan.facades, solids=solids, problems=problems)
    attached = [layout.parts.mesh.shifted(-origin)] if layout else []
    mesh = concatenate([solids.shifted(-origin), *attached, rest])
    if not plan.use.colors:
        mesh = replace(mesh, color=np.full_like(mesh.color, _GREY), surface=np.zeros_like(mesh.surface))
    relief = layout.relief.placed(-origin, faces=len(mesh)) if layout else None
    full_parts = None
    if plan.relief == "full":
        guesses = layout.parts.guessed if layout else np.empty(0, np.bool_)
        faces = np.concatenate([np.zeros(len(solids), np.bool_), guesses, equipment])
        full_parts = FullParts(faces, np.concatenate([added, np.ones(len(on_roofs), np.bool_)]))
    digest = write_tile(SceneFiles(folder).tile(*tile), Tile(origin, mesh, copies, relief, full_parts))
    forest_trees = 0
    if plan.forests is not None:
        box = tile_box(plan.ground, tile[0], j=tile[1])
        forest_trees = forest_tree_count(mesh.shifted(origin), plan.forests, box=box)
    built = len(np.unique(solids.feature))  # `build_solids` has checked each
    verdict = validate_mesh(rest)
    return TileReport(
        *tile,
        built + len(verdict),
        built + int(verdict.ok.sum()),
        built,
        len(mesh),
        len(copies) + 2 * forest_trees,  # a trunk and a crown each
        forest_trees,
        _plan_area(rest.take(~rest.closed)),
        _plan_area(rest.take(~rest.closed & (rest.klass == Class.WATER))),
        digest,
        tuple(problems),
        layout.counts if layout and any(layout.counts.values()) else {},
        guessed,
        roofs,
    )


def _facades(plan: BuildPlan, setting: FacadeSetting, *, solids: Mesh, problems: list[Problem]) -> Layout:
    """Relief of the walls of a tile's buildings and their projecting parts, scene metres."""

    def failed(row: int, error: Exception) -> None:
        problems.append(describe_unexpected(str(plan.buildings.osm_id[row]), error, kind="building"))
        bad.append(row)

    def made(rows: Ints) -> Layout:
        mine = np.isin(solids.feature, rows)
        guess = plan.relief == "full"
        layout = wall_relief(solids.take(mine), setting, base=plan.base, height=plan.height, guess=guess)
        wall = np.full(len(solids), -1, np.int32)
        wall[mine] = layout.relief.wall
        return replace(layout, relief=replace(layout.relief, wall=wall))

    bad: list[int] = []
    rows = np.unique(solids.feature).astype(np.int64)
    found = make_without_failures(made, rows, failed=failed)
    return found[0] if len(found) == 1 and not bad else made(np.setdiff1d(rows, bad))


def _roof_objects(
    plan: BuildPlan, solids: Mesh, *, lod: int, problems: list[Problem]
) -> tuple[ShapeInstances, dict[str, int]]:
    """Rooftop objects of a tile's buildings, scene metres, and their number by shape."""
    none = ShapeInstances.empty()
    if plan.rooftops is None or lod < 2:
        return none, {}
    rooftops = plan.rooftops

    def failed(row: int, error: Exception) -> None:
        problems.append(describe_unexpected(str(plan.buildings.osm_id[row]), error, kind="building"))

    made = make_without_failures(
        lambda rows: roof_objects(solids.take(np.isin(solids.feature, rows)), rooftops),
        np.unique(solids.feature).astype(np.int64),
        failed=failed,
    )
    counts: Counter[str] = Counter()
    for _, some in made:
        counts.update(some)
    return ShapeInstances.concatenate([none, *(copies for copies, _ in made)]), dict(sorted(counts.items()))


def _plan_area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k], :2] for k in range(3))
    return float(cross(b - a, c - a).sum() / 2)


def build_tiles(
    plan: BuildPlan,
    folder: Path,
    *,
    tiles: Sequence[tuple[int, int]],
    lod: int,
    keys: Keys,
    workers: int,
    former: Path | None,
    cluster: DaskCluster | None = None,
) -> Iterator[TileReport]:
    """Build all tiles that are not in ``folder`` yet; yields reports of all tiles, in no particular order.

    Each tile is entered in a journal in ``folder`` once written, so an interrupted build can resume. Tiles of
    the ``former`` scene with the same keys are copied, or their ground is reused. Tiles whose files are
    damaged are built again. Workers of a cluster must see ``folder`` and that scene under the same paths.
    """
    files = SceneFiles(folder)
    files.tiles.mkdir(parents=True, exist_ok=True)
    journalled = _read_journal(folder, keys)
    finished = {tile: journalled[tile] for tile in tiles if tile in journalled}
    kept = {files.tile(*tile) for tile in finished}
    for path in files.tiles.iterdir():
        if path not in kept:  # of a build with other options, damaged or partly written
            path.unlink()
    yield from finished.values()
    remaining = [tile for tile in tiles if tile not in finished]
    job = _Job(plan, folder, lod, _Former.of(former, keys))
    for report in _reports(job, remaining, workers=workers, cluster=cluster):
        with naming(files.tile_journal), files.tile_journal.open("a", encoding="utf-8") as journal:
            journal.write(json.dumps({"keys": asdict(keys), **report.to_json()}) + "\n")
        yield report
    for left in files.tiles.glob("*.part"):  # of workers that were killed while writing
        left.unlink()


def _reports(
    job: _Job, tiles: Sequence[tuple[int, int]], *, workers: int, cluster: DaskCluster | None
) -> Iterator[TileReport]:
    """Reports of tiles as they are built: here, by processes, or by the workers of a cluster."""
    if cluster is None:
        several = workers > 1 and len(tiles) > 1
        yield from run_tasks(job, tiles, workers=workers) if several else map(job, tiles)
    elif tiles:
        file = job.folder / f"plan-{secrets.token_hex(8)}.part"
        write_atomically(file, pickle.dumps(job))
        tasks = [(file, tuple(tiles[k : k + _TILES])) for k in range(0, len(tiles), _TILES)]
        try:
            for reports in cluster.run_tasks(_built, tasks):
                yield from reports
        finally:
            file.unlink(missing_ok=True)


def _built(task: tuple[Path, Sequence[tuple[int, int]]]) -> list[TileReport]:
    """Build the tiles of a task, whose job is in a file; run by workers of a cluster."""
    file, tiles = task
    job = _job_in(file)
    return [job(tile) for tile in tiles]


@functools.lru_cache(maxsize=1)
def _job_in(file: Path) -> _Job:
    job: _Job = pickle.loads(file.read_bytes())  # noqa: S301  (of the program that gave the task)
    return job


@dataclass(frozen=True, slots=True)
class _Former:
    """The scene of an earlier build, and which parts of its tiles can be reused.

    reports : of the tiles whose ground can be reused
    all     : the solids can be reused, too
    """

    files: SceneFiles
    reports: dict[tuple[int, int], TileReport]
    all: bool

    @classmethod
    def of(cls, folder: Path | None, keys: Keys) -> _Former:
        files = SceneFiles(folder or Path())
        document: Any = {"keys": {}}
        if folder is not None:
            with suppress(OSError, ValueError):
                document = json.loads(files.tile_reports.read_text("utf-8-sig"))
        try:
            same = document["keys"].get("ground") == keys.ground
            reports = {(r.i, r.j): r for r in map(_report, document["tiles"])} if same else {}
            return cls(files, reports, all=document["keys"].get("solids") == keys.solids)
        except (LookupError, TypeError, AttributeError):  # damaged
            return cls(files, {}, all=False)

    def build(self, plan: BuildPlan, folder: Path, *, tile: tuple[int, int], lod: int) -> TileReport:
        """Copy or build a tile; see `build_tile`."""
        former = self.files.tile(*tile)
        if tile not in self.reports or file_digest(former) != self.reports[tile].digest:
            return build_tile(plan, folder, tile=tile, lod=lod, former=None)
        if self.all:
            write_atomically(SceneFiles(folder).tile(*tile), former.read_bytes())
            return self.reports[tile]
        return build_tile(plan, folder, tile=tile, lod=lod, former=(former, self.reports[tile]))


@dataclass(frozen=True)
class _Job:
    """Inputs of all tiles; pickled for spawned workers with the precision of its geometries."""

    plan: BuildPlan
    folder: Path
    lod: int
    source: _Former

    def __call__(self, tile: tuple[int, int]) -> TileReport:
        """Build tile (i, j), or copy it from the former scene."""
        return self.source.build(self.plan, self.folder, tile=tile, lod=self.lod)

    def __reduce__(self) -> tuple[Any, ...]:
        buffer = io.BytesIO()
        _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump((self.plan, self.folder, self.lod, self.source))
        return _unpickled_job, (buffer.getvalue(),)


class _Pickler(pickle.Pickler):
    """Keeps the precision of geometries, on which overlays depend; shapely's own pickling drops it."""

    def reducer_override(self, value: Any) -> Any:
        grid = shapely.get_precision(value) if isinstance(value, shapely.Geometry) else 0.0
        return (_on_grid, (shapely.to_wkb(value), grid)) if grid else NotImplemented


def _on_grid(wkb: bytes, grid: float) -> shapely.Geometry:
    return shapely.set_precision(shapely.from_wkb(wkb), grid, mode="pointwise")


def _unpickled_job(data: bytes) -> _Job:
    return _Job(*pickle.loads(data))  # noqa: S301  (from the parent process)


def _report(document: dict[str, Any]) -> TileReport:
    return TileReport(**(document | {"problems": tuple(Problem(**p) for p in document["problems"])}))


def _read_journal(folder: Path, keys: Keys) -> dict[tuple[int, int], TileReport]:
    """Reports by tile of an interrupted build with the same keys in the folder, of undamaged tiles."""
    files = SceneFiles(folder)
    path = files.tile_journal
    reports: dict[tuple[int, int], TileReport] = {}
    for line in path.read_text("utf-8-sig", errors="replace").splitlines() if path.exists() else ():
        try:
            document = json.loads(line)
            same = document.pop("keys") == asdict(keys)
            report = _report(document)
        except (ValueError, LookupError, TypeError, AttributeError):  # the incomplete or a damaged line
            continue
        if same and file_digest(files.tile(report.i, report.j)) == report.digest:
            reports[report.i, report.j] = report
    return reports


def tiles_document(keys: Keys, reports: Sequence[TileReport]) -> dict[str, Any]:
    """The JSON object of the tile reports of a finished scene."""
    return {"keys": asdict(keys), "tiles": [r.to_json() for r in sorted(reports, key=lambda r: (r.i, r.j))]}
