"""Embree 4 from the embreex wheel: loaded, checked and typed. No compiler is needed."""

from __future__ import annotations

import ctypes as c
import functools
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.support.compiled import level
from lidar.errors import BackendError

TRIANGLE, INSTANCE_ARRAY = 0, 122
INDEX, VERTEX, TRANSFORM = 0, 1, 23
UINT, UINT3, FLOAT3, FLOAT3X4_ROW_MAJOR = 0x5001, 0x5003, 0x9003, 0x9134
DYNAMIC, ROBUST = 1 << 0, 1 << 2
LOW, MEDIUM = 0, 1
COHERENT = 1 << 16
INVALID = 0xFFFFFFFF
"""Numbers of Embree's C interface (embree4/rtcore_*.h, version 4.4)."""

_PACKETS = ((16, 34), (8, 33), (4, 32))
_VERSION = 0
_INSTRUCTIONS = {"x86-64-v3": b",max_isa=avx2"}
"""Embree's settings by level of x86-64: as wide packets as code for that level on any machine."""
_TRACERS = [f"rtc{query}{width}" for query in ("Intersect", "Occluded") for width in (1, 4, 8, 16)]

_P, _U, _Z, _I = c.c_void_p, c.c_uint, c.c_size_t, c.c_int
_PROTOTYPES: dict[str, tuple[Any, ...]] = {
    "rtcNewDevice": (_P, c.c_char_p),
    "rtcReleaseDevice": (None, _P),
    "rtcGetDeviceProperty": (c.c_ssize_t, _P, _I),
    "rtcGetDeviceError": (_I, _P),
    "rtcNewScene": (_P, _P),
    "rtcReleaseScene": (None, _P),
    "rtcSetSceneFlags": (None, _P, _I),
    "rtcSetSceneBuildQuality": (None, _P, _I),
    "rtcSetGeometryBuildQuality": (None, _P, _I),
    "rtcCommitScene": (None, _P),
    "rtcNewGeometry": (_P, _P, _I),
    "rtcReleaseGeometry": (None, _P),
    "rtcCommitGeometry": (None, _P),
    "rtcAttachGeometryByID": (None, _P, _P, _U),
    "rtcDetachGeometry": (None, _P, _U),
    "rtcSetGeometryMask": (None, _P, _U),
    "rtcSetGeometryTimeStepCount": (None, _P, _U),
    "rtcSetGeometryInstancedScenes": (None, _P, _P, _Z),
    "rtcSetNewGeometryBuffer": (_P, _P, _I, _U, _I, _Z, _Z),
    "rtcIntersect1": (None, _P, _P, _P),
}


@dataclass(frozen=True)
class Library:
    """The loaded library and a device.

    embree : the loaded library, functions typed
    device : address of the device
    width  : widest packet that the processor supports: 16, 8 or 4, else 1
    """

    embree: c.CDLL
    device: int
    width: int

    def call(self, name: str, *arguments: Any) -> Any:
        """The result of an Embree function; raises BackendError if Embree reports an error."""
        result = getattr(self.embree, name)(*arguments)
        if error := self.embree.rtcGetDeviceError(self.device):
            raise BackendError(f"Embree: {name} failed with error {error}")
        return result


def _path() -> Path:
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise BackendError("embreex is not installed; install it with: pip install 'embreex>=4.4,<5'")
    package = Path(spec.origin).parent
    folders = (package.with_name("embreex.libs"), package / ".dylibs", package)
    found = sorted(p for folder in folders for p in folder.glob("*embree4*") if p.suffix != ".py")
    if not found:
        raise BackendError(f"no Embree 4 library in or next to {package}")
    return found[0]


@functools.cache
def library() -> Library:
    """The library, loaded and checked once in a process.

    Raises BackendError if it is missing, not of version 4, or gives a wrong result for a test ray.
    """
    path = _path()
    try:
        embree = c.CDLL(str(path))
        for name, (result, *arguments) in _PROTOTYPES.items():
            function = getattr(embree, name)
            function.restype, function.argtypes = result, arguments
        _publish(embree)
    except (OSError, AttributeError) as error:
        raise BackendError(f"{path.name}: not a usable Embree 4 library ({error})") from error
    # With one build thread the order of triangles in the tree, and so the face hit at a shared edge, does not
    # depend on the machine, and no threads are lost in a fork.
    device = embree.rtcNewDevice(b"threads=1,start_threads=0" + _INSTRUCTIONS.get(level(), b""))
    if not device:
        raise BackendError(f"{path.name}: no device (error {embree.rtcGetDeviceError(None)})")
    version = embree.rtcGetDeviceProperty(device, _VERSION)
    if version // 10000 != 4:
        raise BackendError(f"{path.name}: Embree version {version}; version 4.x is needed")
    width = next((w for w, code in _PACKETS if embree.rtcGetDeviceProperty(device, code)), 1)
    loaded = Library(embree, device, width)
    _check(loaded)
    return loaded


def _publish(embree: c.CDLL) -> None:
    """Register the tracing functions with numba by name, so that compiled kernels can be cached on disk."""
    import llvmlite.binding as llvm  # noqa: PLC0415

    for name in _TRACERS:
        llvm.add_symbol(name, c.cast(getattr(embree, name), _P).value)


def fill(lib: Library, geometry: int, *, kind: int, slot: int, form: int, rows: np.ndarray[Any, Any]) -> None:
    """Copy the rows (n, ...) of a contiguous array into a new buffer of a geometry."""
    size = rows.itemsize * (rows.size // len(rows))
    target = lib.call("rtcSetNewGeometryBuffer", geometry, kind, slot, form, size, len(rows))
    c.memmove(target, rows.ctypes.data, rows.nbytes)


def _check(lib: Library) -> None:
    """Cast one ray at the second instance of a triangle and compare every field with the known hit.

    The range depends in its last bits on the processor's approximation of reciprocals.
    """
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    shape, top = (lib.call("rtcNewScene", lib.device) for _ in range(2))
    triangle = lib.call("rtcNewGeometry", lib.device, TRIANGLE)
    fill(lib, triangle, kind=VERTEX, slot=0, form=FLOAT3, rows=corners)
    fill(lib, triangle, kind=INDEX, slot=0, form=UINT3, rows=np.array([[0, 0, 0], [0, 1, 2]], np.uint32))
    copies = lib.call("rtcNewGeometry", lib.device, INSTANCE_ARRAY)
    lib.call("rtcSetGeometryInstancedScenes", copies, c.byref(_P(shape)), 1)
    moved = np.tile(np.eye(3, 4, dtype=np.float32), (2, 1, 1))
    moved[:, 2, 3] = -9.0, 2.5
    fill(lib, copies, kind=TRANSFORM, slot=0, form=FLOAT3X4_ROW_MAJOR, rows=moved)
    fill(lib, copies, kind=INDEX, slot=0, form=UINT, rows=np.zeros(2, np.uint32))
    for scene, geometry in ((shape, triangle), (top, copies)):
        lib.call("rtcCommitGeometry", geometry)
        lib.call("rtcAttachGeometryByID", scene, geometry, 0)
        lib.call("rtcReleaseGeometry", geometry)
        lib.call("rtcCommitScene", scene)
    memory = np.zeros(64, np.uint32)
    start = (-memory.ctypes.data % 64) // 4
    ray = memory[start : start + 32]
    ray.view(np.float32)[:9] = 0.25, 0.25, 0.5, 0, 0, 0, 1, 0, np.inf
    ray[9] = ray[18] = ray[19] = ray[20] = INVALID
    lib.call("rtcIntersect1", top, ray.ctypes.data, None)
    for scene in (top, shape):
        lib.call("rtcReleaseScene", scene)
    distance, numbers = float(ray.view(np.float32)[8]), tuple(int(v) for v in ray[17:21])
    if not (abs(distance - 2.0) < 1e-5 and numbers == (1, 0, 0, 1)):
        raise BackendError(
            f"Embree returns {(distance, *numbers)} for a test ray instead of (2.0, 1, 0, 0, 1)"
        )
