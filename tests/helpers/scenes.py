"""Comparison of scene directories, and scenes whose files a test has changed."""

import json

from geoscene.scene.layout import SceneFiles, content_digest, manifest_digest, open_scene


def same_files(a, b):
    """Assert that two directories hold the same files with the same bytes."""
    names = sorted(p.relative_to(a) for p in a.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(b) for p in b.rglob("*") if p.is_file())
    for name in names:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def names_in(folder):
    """Names of what is in a directory, sorted."""
    return sorted(path.name for path in folder.iterdir())


def restated(folder):
    """The scene in a folder, whose files were changed, with their digests in its manifest."""
    files = SceneFiles(folder)
    reports = json.loads(files.tile_reports.read_text())
    for row in reports["tiles"]:
        row["digest"] = content_digest(files.tile(row["i"], row["j"]))
    files.tile_reports.write_text(json.dumps(reports))
    manifest = json.loads(files.manifest.read_text())
    manifest["files"] = {
        path.name: content_digest(path)
        for path in folder.iterdir()
        if path.is_file() and path != files.manifest
    }
    files.manifest.write_text(json.dumps(manifest | {"digest": manifest_digest(manifest)}))
    return open_scene(folder)
