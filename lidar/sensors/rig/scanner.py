"""Specification of a laser scanner: firing pattern, range, noise and beam, read from a TOML file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lidar.sensors.rig.patterns.beams import Firings, Pattern, frame_ns, frame_window_ns
from lidar.sensors.rig.patterns.continuing import read_line, read_listed, read_prisms, read_sweep
from lidar.sensors.rig.patterns.repeating import read_flash, read_scan2d
from lidar.sensors.rig.patterns.spinning import read_spinning
from lidar.toml_table import Table, built_in_names, read_named_table

RETURN_MODES = ("strongest", "last", "first", "dual", "all")
"""Which echoes of a pulse a sensor can report."""

KINDS = ("spinning", "prism", "sweep", "table", "flash", "scan2d", "line")
"""Kinds of scanner; a preset describes its pattern in a table of this name."""

WEAK_SIGMA = (0.09 / math.sqrt(2), 0.0)
"""Default of `Sensor.weak_sigma`: dR / sqrt(2) of LISA (Kilic et al. 2021), with its dR of 0.09 m."""

MOST_JITTER_NS, MOST_CODE_BITS = 1e4, 64
"""Greatest random delay of pulses, and longest code."""

_BUILT_IN = {"package": "lidar.sensors.rig", "folder": "sensors"}

_RATES_HZ = (1e-3, 1e4)
"""Least and greatest rate of a scanner's frames."""

_FWHM = 1.699
"""Ratio of the 1/e^2 full angle of a Gaussian beam to its full width at half maximum, sqrt(2 / ln 2)."""


@dataclass(frozen=True)
class Sensor:
    """A scanner at one rate and in one return mode.

    name          : name on the rig, which also keys its random numbers
    kind          : of `KINDS`
    wavelength_nm : nanometres
    rate_hz       : revolutions or frames per second
    start_ns      : start of frame 0, since the drive's start
    min_range, max_range : metres, limits of the reported range
    range_quantum : metres, step of the reported range; 0 for none
    range_sigma   : metres, standard deviation of a single measurement on a target with a strong return
    bias_sigma    : metres, standard deviation of the lasers' constant errors
    angle_sigma   : radians, standard deviation of the beam's angle
    reference_range, reference_reflectance : range in metres at which a Lambertian target of that reflectance,
                    normal to the beam and larger than it, is detected with probability 1/2 (dark, clear air)
    noise_ratio   : ratio of the standard deviation of the receiver's noise to its threshold
    signal_noise  : standard deviation of the noise in proportion to the received power, over that power
    falloff       : exponent with which received power falls with range, 2 for most
    weak_sigma    : (2,) metres, standard deviation of a range at the detection threshold: of the signal's own
                    noise, which falls with the root of the power, and of the receiver's, which falls with it
    divergence    : (2,) radians, full angles, horizontal and vertical, at which power has fallen to 1/e^2
    aperture      : (2,) metres, width and height of the beam at its start
    pulse_ns      : nanoseconds, the pulse's full width at half maximum
    echo_separation : metres; surfaces closer than this give one echo
    max_echoes    : maximum number of echoes per pulse
    return_mode   : of `RETURN_MODES`
    second_strongest : in dual mode, report the second strongest echo if the strongest is also the last
    diffuse_code  : intensity code of a perfect white Lambertian target
    fmcw          : also measures radial velocity
    velocity_sigma : m/s, standard deviation of the radial velocity
    firing_jitter_ns : nanoseconds over which the sensor delays each pulse at random, known to it alone
    code_bits     : bits of the random code of each pulse; echoes with another code are dropped
    pattern       : firing pattern
    note          : what the preset does not model exactly
    source        : where each number of the preset comes from
    """

    name: str
    kind: str
    maker: str
    model: str
    wavelength_nm: float
    rate_hz: float
    start_ns: int
    min_range: float
    max_range: float
    range_quantum: float
    range_sigma: float
    bias_sigma: float
    angle_sigma: float
    reference_range: float
    reference_reflectance: float
    noise_ratio: float
    divergence: tuple[float, float]
    aperture: tuple[float, float]
    pulse_ns: float
    echo_separation: float
    max_echoes: int
    return_mode: str
    second_strongest: bool
    diffuse_code: float
    fmcw: bool
    pattern: Pattern
    velocity_sigma: float = 0.0
    firing_jitter_ns: float = 0.0
    code_bits: int = 0
    signal_noise: float = 0.0
    falloff: float = 2.0
    weak_sigma: tuple[float, float] = WEAK_SIGMA
    note: str = ""
    source: dict[str, str] = field(default_factory=dict, compare=False)

    def frame_start_ns(self, frame: int) -> int:
        """Start of a frame, nanoseconds since the drive's start."""
        return self.window_ns(frame)[0]

    def window_ns(self, frame: int) -> tuple[int, int]:
        """Start of a frame and of the next one, nanoseconds since the drive's start.

        The pulses of the frame are fired from the first to before the second.
        """
        return frame_window_ns(frame, self.rate_hz, start_ns=self.start_ns)

    def footprint(self, distance: float) -> tuple[float, float]:
        """Width and height in metres of the beam at a distance in metres."""
        wide, high = (a + distance * b for a, b in zip(self.aperture, self.divergence, strict=True))
        return wide, high

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames that end within a drive of this duration."""
        return max(0, int((duration_ns - self.start_ns) // frame_ns(self.rate_hz)))


def firings(sensor: Sensor, frame: int) -> Firings:
    """The pulses of frame ``frame`` of a drive, in the order they are fired."""
    return sensor.pattern.fire(frame, sensor.rate_hz, start_ns=sensor.start_ns)


def sensor_names() -> list[str]:
    """Names of the built-in presets."""
    return built_in_names(**_BUILT_IN)


def load_sensor(
    preset: str | Path,
    *,
    name: str = "",
    rate_hz: float = 0.0,
    return_mode: str = "",
    start_ns: int = 0,
    firing_jitter_ns: float = 0.0,
    code_bits: int = 0,
) -> Sensor:
    """A scanner from a preset (one of `sensor_names`) or a TOML file.

    name        : name on the rig; the preset's by default
    rate_hz     : revolutions or frames per second; 0 for the first of the preset's rates
    return_mode : the first of the preset's modes by default
    start_ns    : start of frame 0, nanoseconds since the drive's start
    firing_jitter_ns, code_bits : as in `Sensor`; 0 for the preset's

    Raises RigError, naming file, line and key, for keys that are missing, unknown or out of bounds.
    """
    table = read_named_table(preset, what="sensor", **_BUILT_IN)
    sensor = _read(
        table, name or Path(preset).stem, rate_hz=rate_hz, return_mode=return_mode, start_ns=start_ns
    )
    return replace(
        sensor,
        firing_jitter_ns=firing_jitter_ns or sensor.firing_jitter_ns,
        code_bits=code_bits or sensor.code_bits,
    )


def _read(table: Table, name: str, *, rate_hz: float, return_mode: str, start_ns: int) -> Sensor:
    kind = table.text("kind", among=KINDS)
    rates = table.numbers("rates_hz")
    rate = rate_hz or rates[0]
    if min(rates) < _RATES_HZ[0] or max(rates) > _RATES_HZ[1]:
        raise table.error("rates_hz", f"rates are {_RATES_HZ[0]:g} to {_RATES_HZ[1]:g} Hz")
    if not min(rates) <= rate <= max(rates):
        raise table.error("rates_hz", f"{rate:g} Hz is not within {min(rates):g} to {max(rates):g}")
    modes = table.texts("return_modes", ("strongest",), among=RETURN_MODES)
    if not modes:
        raise table.error("return_modes", "give one or more")
    mode = return_mode or modes[0]
    if mode not in modes:
        raise table.error("return_modes", f"{mode!r} is not a mode of this sensor: {', '.join(modes)}")
    near = table.number("min_range", low=0.0)
    far = table.number("max_range", above=near, high=1e5)
    pulse_ns = table.number("pulse_ns", above=0.0)
    widening = _FWHM if table.text("divergence_at", "1/e2", among=("1/e2", "fwhm")) == "fwhm" else 1.0
    across, along = (widening * b / 1000 for b in table.numbers("divergence_mrad", count=2, spread=True))
    wide, high = (a / 1000 for a in table.numbers("aperture_mm", 0.0, count=2, spread=True))
    own, background = table.numbers("weak_sigma", WEAK_SIGMA, count=2)
    if min(own, background) < 0:
        raise table.error("weak_sigma", f"{min(own, background):g} is under 0")
    sensor = Sensor(
        name=name,
        kind=kind,
        maker=table.text("maker"),
        model=table.text("model"),
        wavelength_nm=table.number("wavelength_nm", low=300.0, high=11000.0),
        rate_hz=rate,
        start_ns=start_ns,
        min_range=near,
        max_range=far,
        range_quantum=table.number("range_quantum", 0.0, low=0.0),
        range_sigma=table.number("range_sigma", low=0.0),
        bias_sigma=table.number("bias_sigma", 0.0, low=0.0),
        angle_sigma=float(np.radians(table.number("angle_sigma_deg", 0.0, low=0.0, high=10.0))),
        reference_range=table.number("reference_range", above=0.0),
        reference_reflectance=table.number("reference_reflectance", above=0.0),
        noise_ratio=table.number("noise_ratio", 0.18, above=0.0, high=1.0),
        divergence=(across, along),
        aperture=(wide, high),
        pulse_ns=pulse_ns,
        echo_separation=table.number("echo_separation", 0.299792458 * pulse_ns / 2, low=0.0),
        max_echoes=table.integer("max_echoes", 1, low=1, high=64),
        return_mode=mode,
        second_strongest=table.flag("second_strongest", False),
        diffuse_code=table.number("diffuse_code", 100.0, above=0.0, high=255.0),
        fmcw=table.flag("fmcw", False),
        velocity_sigma=table.number("velocity_sigma", 0.0, low=0.0),
        firing_jitter_ns=table.number("firing_jitter_ns", 0.0, low=0.0, high=MOST_JITTER_NS),
        code_bits=table.integer("code_bits", 0, low=0, high=MOST_CODE_BITS),
        signal_noise=table.number("signal_noise", 0.0, low=0.0, high=1.0),
        falloff=table.number("falloff", 2.0, low=1.0, high=4.0),
        weak_sigma=(own, background),
        pattern=_READERS[kind](table.table(kind), rate, rates),
        note=table.text("note", ""),
        source={key: table.table("source").text(key) for key in table.table("source", {}).data},
    )
    table.close()
    return sensor


_READERS: dict[str, Callable[[Table, float, tuple[float, ...]], Pattern]] = {
    "spinning": lambda table, _rate, _rates: read_spinning(table),
    "prism": lambda table, _rate, _rates: read_prisms(table),
    "sweep": lambda table, _rate, _rates: read_sweep(table),
    "table": lambda table, _rate, _rates: read_listed(table),
    "flash": lambda table, rate, _rates: read_flash(table, rate),
    "line": lambda table, _rate, _rates: read_line(table),
    "scan2d": lambda table, rate, rates: read_scan2d(table, rate, rates_hz=rates),
}
