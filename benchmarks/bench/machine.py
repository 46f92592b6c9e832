"""The machine that a benchmark runs on, and whether it is free."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

LIBRARIES = (
    *("numpy", "scipy", "numba", "embreex", "open3d", "open3d-cpu", "trimesh", "shapely", "osmium", "laspy"),
    *("lazrs", "pyproj", "manifold3d"),
)
BUSY = 0.25
"""Load average per core from which a machine counts as loaded."""


def described() -> dict[str, Any]:
    """Processor, memory, system, versions and load of this machine."""
    parts = {
        "cpu": _cpu(),
        "cores": os.cpu_count() or 1,
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": f"{platform.system()} {platform.release()}",
    }
    named = "|".join(str(value) for value in parts.values()) + platform.node() + _machine_id()
    return {
        **parts,
        "machine": hashlib.blake2b(named.encode(), digest_size=8).hexdigest(),
        "usable_cores": len(os.sched_getaffinity(0)),
        "python": sys.version.split()[0],
        "libraries": {name: found for name in LIBRARIES if (found := _version(name))},
        "geoscene": _version("geoscene"),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "load": load(),
    }


def load() -> float:
    """Load average of the last minute."""
    return round(os.getloadavg()[0], 2)


def warnings_about(machine: dict[str, Any], load_at_end: float | None = None) -> list[str]:
    """Sentences about what makes figures of this machine uncertain.

    load_at_end : load average after the run, of which the run itself is a part
    """
    cores, found = machine["cores"], []
    if machine["load"] > BUSY * cores:
        found.append(
            f"the machine was loaded at the start: load average {machine['load']} on {cores} cores;"
            " ratios are by turns, rates are too low"
        )
    if load_at_end is not None and load_at_end > (1 + BUSY) * cores:
        found.append(f"other programs ran beside the benchmark: load average {load_at_end} at the end")
    return found


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _machine_id() -> str:
    path = Path("/etc/machine-id")
    return path.read_text().strip() if path.exists() else ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
