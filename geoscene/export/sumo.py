"""SUMO networks, converted from OpenDRIVE by SUMO's netconvert."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from geoscene.errors import GeosceneError, need
from geoscene.export.files import Summary
from geoscene.export.opendrive import write_opendrive
from geoscene.scene import Scene
from geoscene.support.files import atomic_file, temporary_folder
from geoscene.support.progress import Progress, silent

_STAMP = re.compile(rb"<!--.*?-->\s*", re.DOTALL)
_VALUES = re.compile(r"'[^']*'|\b(start|end)\b|-?\d+(\.\d+)?")  # what differs between warnings of a kind


def write_sumo(scene: Scene, path: Path, *, progress: Progress = silent) -> Summary:
    """Write the road graph as a SUMO network (``.net.xml``).

    The network is converted by ``netconvert`` of the package eclipse-sumo from the file of `write_opendrive`;
    its comments contain the time of day and are removed. Its warnings are notes of the summary, one for each
    kind. Edge -7 is the right side of road 7 of `write_opendrive`.

    Raises MissingExtraError without eclipse-sumo, SceneFormatError for a scene without roads, GeosceneError
    with the last line of netconvert's output if that fails.
    """
    home = Path(need("sumo", "sumo").SUMO_HOME)
    with temporary_folder(path, "roads") as folder:
        roads, net = folder / "roads.xodr", folder / "roads.net.xml"
        roads_summary = write_opendrive(scene, roads, progress=progress)
        files = ("--opendrive-files", roads, "--output-file", net)
        command = (home / "bin" / "netconvert", *files, "--aggregate-warnings", "-1")  # `_warnings` does so
        # no shell; only the folder's name comes from the user
        run = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if run.returncode or not net.exists():
            lines = [line for line in run.stderr.splitlines() if line.strip()] or ["no message"]
            raise GeosceneError(f"netconvert failed: {lines[-1]}")
        with atomic_file(path) as out:
            out.write(_STAMP.sub(b"", net.read_bytes()))
    notes = (*roads_summary.notes, *_warnings(run.stderr))
    return Summary.of(path, "sumo", objects=roads_summary.objects, crs=scene.frame.name, notes=notes)


def _warnings(text: str) -> list[str]:
    """One line for each kind of warning of netconvert: their number and the first one."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("Warning: "):
            warning = line.removeprefix("Warning: ").strip()
            found.setdefault(_VALUES.sub("%", warning), []).append(warning)
    return [
        f"netconvert: {same[0]}" + (f" ({len(same)} warnings of this kind)" if len(same) > 1 else "")
        for same in found.values()
    ]
