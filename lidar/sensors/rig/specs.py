"""Specification of a rig: the sensors of a vehicle, their mounts and their timing, read from TOML."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from geoscene.errors import reason_of
from geoscene.support.digests import recipe_digest
from geoscene.support.untrusted import read_toml
from lidar.errors import InputError, RigError
from lidar.geometry.attitude import OPTICAL_QUAT, Mount, quat_from_euler, quat_product
from lidar.sensors.rig.imu_grades import PRESETS
from lidar.sensors.rig.names import folded, name_fault
from lidar.sensors.rig.scanner import MOST_CODE_BITS, MOST_JITTER_NS
from lidar.toml_table import Table, built_in_names, read_named_table, unknown_built_in

_BUILT_IN = {"package": "lidar.sensors.rig", "folder": "rigs"}
_SCANNERS = {"package": "lidar.sensors.rig", "folder": "sensors"}


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """A laser scanner on the rig.

    preset         : name of a built-in preset, or the path of a TOML file
    mount          : pose in the vehicle's frame of the sensor frame (x forward, y left, z up)
    rate_hz        : revolutions or frames per second; 0 for the preset's own
    time_offset_ns : start of frame 0 after the drive's start
    return_mode    : one of the preset's modes; empty for its first
    firing_jitter_ns, code_bits : random delay and code of pulses, as in `scanner.Sensor`; 0 for the
                     preset's
    """

    name: str
    preset: str
    mount: Mount = Mount()  # noqa: RUF009 - frozen
    rate_hz: float = 0.0
    time_offset_ns: int = 0
    return_mode: str = ""
    firing_jitter_ns: float = 0.0
    code_bits: int = 0


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """A camera on the rig.

    mount          : pose in the vehicle's frame of the camera frame (z forward, x right, y down)
    width, height  : pixels
    fx, fy, cx, cy : pixels; the centre of the top-left pixel is (0, 0)
    distortion     : pinhole: k1, k2, p1, p2, k3 (Brown-Conrady); fisheye: k1, k2, k3, k4 (equidistant)
    near, far      : metres along the optical axis; surfaces outside these limits are not imaged
    rate_hz        : frames per second
    time_offset_ns : start of frame 0 after the drive's start
    images         : kinds of image to write, of `IMAGES`
    exposure_ns    : exposure time of a row
    row_ns         : time from the start of one row to the next; 0 for a global shutter
    exposure_ev    : exposure compensation in stops, added to the automatic exposure
    full_well      : electrons of a pixel at full scale, which determine the photon noise
    read_noise     : standard deviation of the read-out noise, electrons
    model          : pinhole or fisheye
    """

    name: str
    mount: Mount
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    near: float = 0.1
    far: float = 200.0
    rate_hz: float = 10.0
    time_offset_ns: int = 0
    images: tuple[str, ...] = ("rgb", "depth")
    exposure_ns: int = 0
    row_ns: int = 0
    exposure_ev: float = 0.0
    full_well: float = 10_000.0
    read_noise: float = 4.0
    model: str = "pinhole"


SYSTEMS = ("gps", "glonass", "galileo", "beidou")
"""Names of the satellite systems, in the order in which satellites are numbered."""

SLOWEST_HZ = 1e-3
"""Least rate of a sensor's frames or measurements."""

MOST_PIXELS = 64 * 10**6
"""Greatest size of an image: a frame takes about 25 bytes of memory for each pixel."""

IMAGES = ("rgb", "depth", "semantic", "instance", "flow")
"""Kinds of image that a camera can write."""


@dataclass(frozen=True, slots=True)
class GnssSpec:
    """A GNSS receiver on the rig.

    mount          : its translation is the lever arm to the antenna
    rate_hz        : fixes per second
    time_offset_ns : first fix after the drive's start
    mode           : of `GNSS_MODES`
    mask_deg       : elevation below which satellites are not used
    constellations : satellite systems that it receives, of `SYSTEMS`
    """

    name: str
    mount: Mount
    rate_hz: float = 10.0
    time_offset_ns: int = 0
    mode: str = "single"
    mask_deg: float = 10.0
    constellations: tuple[str, ...] = SYSTEMS


GNSS_MODES = ("single", "sbas", "rtk", "ideal")
"""Modes of a GNSS receiver."""


@dataclass(frozen=True, slots=True)
class ImuSpec:
    """An inertial measurement unit; the noise defaults are EuRoC's Allan parameters of its ADIS16448.

    gyro_noise : rad/s/sqrt(Hz)
    gyro_walk  : rad/s^2/sqrt(Hz)
    accel_noise : m/s^2/sqrt(Hz)
    accel_walk : m/s^3/sqrt(Hz)
    gyro_instability, accel_instability : rad/s and m/s^2, bias instability (flicker noise)
    """

    name: str
    mount: Mount
    rate_hz: float = 100.0
    time_offset_ns: int = 0
    gyro_noise: float = 1.6968e-4
    gyro_walk: float = 1.9393e-5
    accel_noise: float = 2.0e-3
    accel_walk: float = 3.0e-3
    gyro_instability: float = 0.0
    accel_instability: float = 0.0


@dataclass(frozen=True, slots=True)
class Rig:
    """The sensors of one vehicle.

    vehicle : default vehicle, for which the mounts are given (car, drone, ...)
    source  : reference for the mounts
    """

    name: str
    lidars: tuple[LidarSpec, ...] = ()
    cameras: tuple[CameraSpec, ...] = ()
    gnss: tuple[GnssSpec, ...] = ()
    imus: tuple[ImuSpec, ...] = ()
    vehicle: str = "car"
    source: str = ""


def _mount(table: Table, *, camera: bool = False) -> Mount:
    translation = table.numbers("translation", (0.0, 0.0, 0.0), count=3)
    if table.has("quat_wxyz"):
        if table.has("rpy_deg"):
            raise table.error("rpy_deg", "give rpy_deg or quat_wxyz, not both")
        w, x, y, z = table.numbers("quat_wxyz", count=4)
        if not 0.99 < w * w + x * x + y * y + z * z < 1.01:
            raise table.error("quat_wxyz", "not a unit quaternion")
        rotation = np.array([x, y, z, w]) / np.sqrt(w * w + x * x + y * y + z * z)
    else:
        roll, pitch, yaw = np.radians(table.numbers("rpy_deg", (0.0, 0.0, 0.0), count=3))
        rotation = quat_from_euler(roll, pitch, gamma=yaw)
        if camera:
            rotation = quat_product(rotation, OPTICAL_QUAT)
    a, b, c = translation
    qx, qy, qz, qw = (float(q) for q in rotation)
    return Mount((a, b, c), (qx, qy, qz, qw))


def _lidar(table: Table, folder: Path) -> LidarSpec:
    preset = table.text("preset")
    if not preset.endswith(".toml") and preset not in (known := built_in_names(**_SCANNERS)):
        raise table.error("preset", unknown_built_in("sensor", preset, names=known))
    rate_hz = table.number("rate_hz", 0.0, low=0.0, high=1e4)
    if 0 < rate_hz < SLOWEST_HZ:
        raise table.error("rate_hz", f"{rate_hz:g} is under {SLOWEST_HZ:g}")
    return LidarSpec(
        name=table.text("name"),
        preset=str(folder / preset) if preset.endswith(".toml") else preset,
        mount=_mount(table),
        rate_hz=rate_hz,
        time_offset_ns=table.integer("time_offset_ns", 0, low=0),
        return_mode=table.text("return_mode", ""),
        firing_jitter_ns=table.number("firing_jitter_ns", 0.0, low=0.0, high=MOST_JITTER_NS),
        code_bits=table.integer("code_bits", 0, low=0, high=MOST_CODE_BITS),
    )


def _camera(table: Table) -> CameraSpec:
    model = table.text("model", "pinhole", among=("pinhole", "fisheye"))
    width, height = (table.integer(key, low=1, high=65535) for key in ("width", "height"))
    if width * height > MOST_PIXELS:
        raise table.error("height", f"{width} x {height} pixels are over {MOST_PIXELS // 10**6} megapixels")
    if table.has("fx"):
        if table.has("fov_deg"):
            raise table.error("fov_deg", "give fx or fov_deg, not both")
        fx = table.number("fx", above=0.0)
    else:
        half = np.radians(table.number("fov_deg", above=0.0, high=180.0 if model == "pinhole" else 360.0)) / 2
        if model == "pinhole" and half > np.radians(89.5):
            raise table.error(
                "fov_deg", "a pinhole camera cannot see 179 degrees or more; use model = 'fisheye'"
            )
        fx = float(width / 2 / (np.tan(half) if model == "pinhole" else half))
    near = table.number("near", 0.1, above=0.0)
    return CameraSpec(
        name=table.text("name"),
        mount=_mount(table, camera=True),
        width=width,
        height=height,
        fx=fx,
        fy=table.number("fy", fx, above=0.0),
        cx=table.number("cx", (width - 1) / 2),
        cy=table.number("cy", (height - 1) / 2),
        distortion=table.numbers(
            "distortion", (0.0,) * (5 if model == "pinhole" else 4), count=5 if model == "pinhole" else 4
        ),
        near=near,
        far=table.number("far", 200.0, above=near),
        rate_hz=table.number("rate_hz", 10.0, low=SLOWEST_HZ, high=1e4),
        time_offset_ns=table.integer("time_offset_ns", 0, low=0),
        images=table.texts("images", ("rgb", "depth"), among=IMAGES),
        exposure_ns=table.integer("exposure_ns", 0, low=0),
        row_ns=table.integer("row_ns", 0, low=0),
        exposure_ev=table.number("exposure_ev", 0.0, low=-20.0, high=20.0),
        full_well=table.number("full_well", 10_000.0, above=0.0),
        read_noise=table.number("read_noise", 4.0, low=0.0),
        model=model,
    )


def _gnss(table: Table) -> GnssSpec:
    return GnssSpec(
        name=table.text("name", "gnss"),
        mount=_mount(table),
        rate_hz=table.number("rate_hz", 10.0, low=SLOWEST_HZ, high=1e3),
        time_offset_ns=table.integer("time_offset_ns", 0, low=0),
        mode=table.text("mode", "single", among=GNSS_MODES),
        mask_deg=table.number("mask_deg", 10.0, low=0.0, high=90.0),
        constellations=table.texts("constellations", SYSTEMS, among=SYSTEMS),
    )


_NOISES = tuple(
    f"{sensor}_{kind}" for sensor in ("gyro", "accel") for kind in ("noise", "walk", "instability")
)


def _imu(table: Table) -> ImuSpec:
    preset = PRESETS[table.text("model", "adis16448", among=tuple(PRESETS))]
    return ImuSpec(
        name=table.text("name", "imu"),
        mount=_mount(table),
        rate_hz=table.number("rate_hz", 100.0, low=SLOWEST_HZ, high=1e5),
        time_offset_ns=table.integer("time_offset_ns", 0, low=0),
        **{name: table.number(name, getattr(preset, name), low=0.0) for name in _NOISES},
    )


def rig_names() -> list[str]:
    """Names of the built-in rigs."""
    return built_in_names(**_BUILT_IN)


def load_rig(name: str | Path) -> Rig:
    """A rig by name (one of `rig_names`) or from a TOML file.

    A preset given as a path ending in ``.toml`` is relative to the folder of the rig's file. Raises RigError,
    naming file, line and key, for keys that are missing, unknown or out of bounds.
    """
    folder, root = Path(name).parent, read_named_table(name, what="rig", **_BUILT_IN)
    tables = {key: root.tables(key) for key in ("lidar", "camera", "gnss", "imu")}
    rig = Rig(
        name=root.text("name", Path(name).stem),
        lidars=tuple(_lidar(t, folder) for t in tables["lidar"]),
        cameras=tuple(_camera(t) for t in tables["camera"]),
        gnss=tuple(_gnss(t) for t in tables["gnss"]),
        imus=tuple(_imu(t) for t in tables["imu"]),
        vehicle=root.text("vehicle", "car"),
        source=root.text("source", ""),
    )
    root.close()
    _check_names(tables)
    return rig


def rig_of(rig: str) -> Rig:
    """A rig as a recipe names it: its name or file, and a digest.

    Raises RigError if its file is not there, and InputError if it has changed since.
    """
    name = rig.rpartition(" (")[0]
    if name.endswith(".toml") and not Path(name).is_file():
        raise RigError(
            f"rig {name}: the drive's file is not there; run the command in the directory of `lidar drive`,"
            " or put the file back"
        )
    if f"{name} ({rig_digest(name)})" != rig:
        raise InputError(f"rig {name}: has changed since the drive")
    return load_rig(name)


def rig_digest(name: str | Path) -> str:
    """Digest of the contents of a rig's files: its own, its scanners' and their lists of directions.

    Raises RigError as `load_rig` does, and for a scanner's file that cannot be read.
    """
    rig = load_rig(name)
    inside = resources.files("lidar.sensors.rig")
    parts: list[bytes] = []
    try:
        own = Path(name) if str(name).endswith(".toml") else inside / "rigs" / f"{name}.toml"
        parts.append(own.read_bytes())
        for spec in rig.lidars:
            if not spec.preset.endswith(".toml"):
                parts.append((inside / "sensors" / f"{spec.preset}.toml").read_bytes())
                continue
            parts.append(Path(spec.preset).read_bytes())
            listed = read_toml(parts[-1].decode("utf-8-sig")).get("table", {}).get("file", "")
            parts += [(Path(spec.preset).parent / listed).read_bytes()] if listed else []
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise RigError(f"rig {name}: a sensor's file cannot be read: {reason_of(error)}") from error
    return recipe_digest(b"".join(len(part).to_bytes(8) + part for part in parts))


def _check_names(tables: dict[str, list[Table]]) -> None:
    """Raise RigError for unknown keys, and for names that repeat or cannot name files of a dataset."""
    seen: dict[str, str] = {}
    for kind, group in tables.items():
        for table in group:
            table.close()
            name = table.data.get("name", kind)
            if fault := name_fault(name, kind=kind):
                raise table.error("name", fault)
            if other := seen.get(folded(name)):
                same = "" if other == name else f", as {other!r} where file systems do not tell case apart"
                raise table.error(
                    "name",
                    f"{name!r} is taken by another sensor of the rig{same}; write {name}_2, for example",
                )
            seen[folded(name)] = name
