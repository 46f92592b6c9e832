"""Plots of weather against published values."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from geoscene.drawing.canvas import Canvas
from geoscene.drawing.charts import Axes
from geoscene.drawing.panels import Panel, Series, figure
from geoscene.typing import Float
from lidar.sensors.physics.link import amplitude
from lidar.sensors.rig.scanner import Sensor
from lidar.signal.weather.backscatter import LENS, drawn_particles, even_echo, least_power, particles
from lidar.signal.weather.lisa import goodin_extinction
from lidar.signal.weather.media import fog_extinction, medium_of, rain_extinction, snow_extinction

# Published, or computed from published formulas, at 905 nm: visibility in m and extinction in 1/m.
_KIM = ((50, 0.07824), (200, 0.01956), (1000, 3.050e-3), (10_000, 2.048e-4))
_KRUSE = ((50, 0.07028), (200, 0.01650), (1000, 2.923e-3), (10_000, 2.048e-4))
# Rain rate in mm/h and extinction in 1/m: Mie; Ulbrich and Atlas; Goodin et al.; snow, ice spheres.
_MIE = ((1, 3.67e-4), (10, 1.563e-3), (50, 4.304e-3))
_ULBRICH_ATLAS = ((1, 3.34e-4), (10, 1.457e-3), (50, 4.083e-3))
_GOODIN = ((1, 1.00e-2), (10, 3.98e-2), (50, 1.05e-1))
_ICE = ((0.5, 9.76e-4), (1, 1.447e-3), (5, 3.61e-3))
# Share of targets of reflectance 0.9 that are lost at 10 mm/h, evenly spread over the 100 m of clear air.
_LOST_GOODIN, _LOST_ULBRICH_ATLAS = ((10, 1 - 0.3013),), ((10, 1 - 0.8797),)

_SKY = np.full(200_000, np.inf)  # ends of beams


def weather_figure(sensor: Sensor) -> Canvas:
    """Range by visibility, extinction and lost returns by rate, and ranges of what air sends back."""
    return figure([_ranges(sensor), _extinctions(), _lost(), _histogram(sensor)])


def max_range(sensor: Sensor, reflectance: float, *, extinction: float) -> float:
    """Metres at which a target is detected with probability 1/2, the root of the link equation."""

    def excess(distance: float) -> float:
        clear = amplitude(
            reflectance,
            distance,
            reference_reflectance=sensor.reference_reflectance,
            reference_range=sensor.reference_range,
            falloff=sensor.falloff,
        )
        return float(np.log(clear)) - 2 * extinction * distance

    return float(brentq(excess, 1e-3, 1e6))


def _ranges(sensor: Sensor) -> Panel:
    visibility = np.geomspace(20, 20_000, 80)
    series = [
        Series(
            f"target {100 * rho:g} %",
            [
                (v, max_range(sensor, rho, extinction=fog_extinction(v, sensor.wavelength_nm)))
                for v in visibility.tolist()
            ],
        )
        for rho in (0.1, 0.5, 0.9)
    ]
    for name, table in (("Kim, 50 %", _KIM), ("Kruse, 50 %", _KRUSE)):
        found = [(v, max_range(sensor, 0.5, extinction=alpha)) for v, alpha in table]
        series.append(Series(f"{name}, published", found, dots=True))
    title = f"Maximum range of a {sensor.model} in fog"
    return Panel(Axes(title, "visibility, m (2 % contrast)", "range, m", _plain), series)


def _extinctions() -> Panel:
    rates = np.geomspace(0.3, 100, 60).tolist()
    series = [
        Series("rain, Mie", [(r, rain_extinction(r, 905)) for r in rates]),
        Series(
            "snow, Stallabrass",
            [(r, snow_extinction(r, 905, medium="stallabrass")) for r in rates if r <= 20],
        ),
        Series("snow, Gunn-Marshall", [(r, snow_extinction(r, 905)) for r in rates if r <= 20]),
        Series("snow, ITU-R dry", [(r, snow_extinction(r, 905, medium="itu-dry")) for r in rates if r <= 20]),
        Series("Goodin's rain", [(r, goodin_extinction(r)) for r in rates]),
        Series("rain, Mie, published", _MIE, dots=True),
        Series("rain, Ulbrich-Atlas", _ULBRICH_ATLAS, dots=True),
        Series("snow, published", _ICE, dots=True),
        Series("Goodin, published", _GOODIN, dots=True),
    ]
    return Panel(Axes("Extinction at 905 nm", "rain or snowfall rate, mm/h", "1/m", _plain), series)


def lost_share(extinction: float, *, reach: float = 100.0) -> float:
    """Share of targets that are lost of those evenly spread over the range ``reach`` of clear air, metres."""
    return 1 - float(brentq(lambda r: 2 * np.log(reach / r) - 2 * extinction * r, 1e-3, reach)) / reach


def _lost() -> Panel:
    rates = np.linspace(0.1, 100, 60).tolist()
    series = [
        Series("rain, physical and LISA", [(r, lost_share(rain_extinction(r, 905))) for r in rates]),
        Series(
            "snow",
            [(r, lost_share(snow_extinction(r, 905, medium="stallabrass"))) for r in rates if r <= 20],
        ),
        Series("Goodin's rain", [(r, lost_share(goodin_extinction(r))) for r in rates]),
        Series("Ulbrich-Atlas", _LOST_ULBRICH_ATLAS, dots=True),
        Series("Goodin, published", _LOST_GOODIN, dots=True),
    ]
    title = "Returns lost, targets evenly spread over 100 m"
    axes = Axes(title, "rain or snowfall rate, mm/h", "share lost", _plain)
    return Panel(axes, series, x_log=False, y_log=False)


def _histogram(sensor: Sensor) -> Panel:
    """Echoes per pulse into the sky and metre of range that pass the threshold."""
    edges = np.arange(0, 20.5, 0.5)
    series = []
    for name, kind, amount in (
        ("rain 50 mm/h", "rain", 50.0),
        ("snow 1 mm/h", "snow", 1.0),
        ("snow 5 mm/h", "snow", 5.0),
    ):
        medium = medium_of(kind, amount, wavelength_nm=sensor.wavelength_nm, medium=_FIRST[kind])
        some, _, _ = particles(sensor, medium)
        _, place, power = drawn_particles(
            some, _SKY, extinction=medium.extinction, rng=np.random.default_rng(0)
        )
        count = np.histogram(place[power > 1], edges)[0] / len(_SKY) / 0.5
        series.append(Series(name, _steps(edges, count)))
    fog = medium_of("fog", 50.0, wavelength_nm=sensor.wavelength_nm, medium="kim")
    soft = even_echo(sensor, fog, lens=LENS, noise=sensor.noise_ratio)
    seen, middle = soft.power[-1] > least_power(sensor.noise_ratio), float(np.median(soft.place[-1]))
    series += [
        Series(
            f"fog 50 m, {soft.power[-1]:.2g} x threshold",
            [(middle, 1e-5), (middle, 1.0)] if seen else [],
        ),
        Series("fog, Hahner 2021: 1.6 m", ((1.60, 1.0),), dots=True),
    ]
    axes = Axes(f"Echoes of air over the threshold, {sensor.model}", "range, m", "per pulse and m", _plain)
    return Panel(axes, series, x_log=False)


_FIRST = {"rain": "marshall-palmer", "snow": "stallabrass"}


def _steps(edges: Float, count: Float) -> list[tuple[float, float]]:
    """The outline of a histogram; bins without a count are left out."""
    outline = zip(np.repeat(edges, 2)[1:-1].tolist(), np.repeat(count, 2).tolist(), strict=True)
    return [(x, y) for x, y in outline if y > 0]


def _plain(value: float) -> str:
    return f"{value:g}"
