"""Names of sensors, which name folders and files of a dataset."""

from __future__ import annotations

import unicodedata

RESERVED = frozenset(
    {"boxes", "calibration", "checksums", "dataset", "frames", "integrity", "poses", "trajectory", "truth"}
)
"""Names of a dataset's own files and folders without their suffixes, `lidar.dataset.layout.Paths`."""

_DEVICES = frozenset(
    {"aux", "con", "nul", "prn", *(f"{port}{number}" for port in ("com", "lpt") for number in range(10))}
)
"""Names that Windows reserves for devices, with any suffix ("Naming Files, Paths, and Namespaces")."""

LONGEST = 50
"""Characters of a name: with suffixes of temporary files, names of files stay within 255 bytes of UTF-8."""


def names_folder(name: str) -> bool:
    """Whether a sensor's name can name its folder: letters, digits, _ and - only."""
    return bool(name) and all(c.isalnum() or c in "_-" for c in name)


def folded(name: str) -> str:
    """A name without case and without variants of letters, which not all file systems tell apart."""
    return unicodedata.normalize("NFKC", name).casefold()


def name_fault(name: str, *, kind: str) -> str:
    """What is wrong with the name of a sensor, and what to write; empty for a valid one.

    kind : of the sensor: lidar, camera, gnss or imu
    """
    kept = "".join(c for c in name if names_folder(c))[: LONGEST - len(kind) - 1]
    other = f"{kind}_{kept}" if _is_taken(kept) else kept or kind
    if not names_folder(name):
        fault = "letters, digits, _ and - only, as it names files"
    elif len(name) > LONGEST:
        fault = f"{len(name)} characters, of {LONGEST} at most"
    elif folded(name) in RESERVED:
        fault = "the dataset has a file of this name"
    elif folded(name) in _DEVICES:
        fault = "Windows has a device of this name, and no file can have it"
    else:
        return ""
    shown = repr(name) if len(name) <= LONGEST else f"{name[:20]!r}..."
    return f"{shown}: {fault}; write {other}, for example"


def _is_taken(name: str) -> bool:
    return folded(name) in RESERVED | _DEVICES
