"""Media against published and computed values; the sources are in docs/reference/weather.md."""

import numpy as np
import pytest

from lidar.signal.weather.media import (
    CONTRAST,
    drop_backscatter,
    droplet_optics,
    fog_extinction,
    fog_ratio,
    medium_of,
    rain,
    rain_extinction,
    snow,
    snow_extinction,
    snow_slope,
    water_index,
)
from lidar.signal.weather.mie import mie_efficiencies
from lidar.signal.weather.setting import WeatherSetting

DB_PER_KM = 4342.9


def _visibility(kind, amount, medium):
    return CONTRAST / medium_of(kind, amount, wavelength_nm=550.0, medium=medium).extinction


# Bohren and Huffman's example, and spheres of water by miepython 3.3.0.
SPHERES = [
    (5.213, 1.55, 3.10499592, 3.10499592, 2.92420913),
    (0.05, 1.328 + 4.9e-7j, 7.4110515e-7, 6.8592573e-7, 1.0277491e-6),
    (10.0, 1.318 + 9.6e-5j, 2.400895925918, 2.396544328606, 0.577948584849),
    (1000.0, 1.328 + 4.9e-7j, 2.016845531188, 2.015164698899, 2.340899894691),
    (6000.0, 1.318 + 9.6e-5j, 2.005656716674, 1.198060196222, 0.013893972193),
]


@pytest.mark.parametrize(("size", "index", "extinction", "scattering", "back"), SPHERES)
def test_spheres_scatter_as_the_series_of_mie_says(size, index, extinction, scattering, back):
    found = [float(q[0]) for q in mie_efficiencies(size, index)]
    assert found == pytest.approx([extinction, scattering, back], rel=2e-6)


def test_bohren_and_huffmans_example():
    extinction, scattering, back = mie_efficiencies(5.213, 1.55)
    assert extinction[0] == pytest.approx(3.1054, rel=1e-3)
    assert scattering[0] == pytest.approx(3.1054, rel=1e-3)
    assert back[0] == pytest.approx(2.9253, rel=1e-3)


@pytest.mark.parametrize(
    ("medium", "visibility", "at_905", "at_1550"),
    [
        ("kim", 50, 0.07824, 0.07824),
        ("kim", 200, 0.01956, 0.01956),
        ("kim", 1000, 3.050e-3, 2.330e-3),
        ("kim", 10_000, 2.048e-4, 1.017e-4),
        ("kruse", 50, 0.07028, 0.06258),
        ("kruse", 200, 0.01650, 0.01372),
        ("kruse", 1000, 2.923e-3, 2.134e-3),
        ("kruse", 10_000, 2.048e-4, 1.017e-4),
    ],
)
def test_extinction_of_fog(medium, visibility, at_905, at_1550):
    assert fog_extinction(visibility, 905, medium=medium) == pytest.approx(at_905, rel=1e-3)
    assert fog_extinction(visibility, 1550, medium=medium) == pytest.approx(at_1550, rel=1e-3)


def test_extinction_of_advection_and_radiation_fog():
    assert fog_extinction(200, 905, medium="advection") == pytest.approx(0.01970, rel=1e-3)
    assert fog_extinction(200, 905, medium="radiation") == pytest.approx(0.02011, rel=1e-3)


def test_measured_attenuation_of_fog_is_8_to_17_db_over_the_visibility():
    # Pierce et al., SPIE 4530; Koschmieder's law is the upper end.
    for medium in ("kim", "kruse", "advection", "radiation", "moderate-advection"):
        assert 8.5 < DB_PER_KM * fog_extinction(200, 905, medium=medium) * 0.2 < 18


@pytest.mark.parametrize(("rate", "mie"), [(1, 3.67e-4), (10, 1.563e-3), (50, 4.304e-3)])
def test_extinction_of_rain(rate, mie):
    assert rain_extinction(rate, 905) == pytest.approx(mie, rel=5e-3)
    assert rain_extinction(rate, 1550) == pytest.approx(rain_extinction(rate, 905), rel=3e-3)
    large = rain_extinction(rate, 905, medium="large-drop")
    assert large == pytest.approx(3.6466e-4 * rate**0.63, rel=1e-4)
    assert 1.001 < rain_extinction(rate, 905) / large < 1.011


@pytest.mark.parametrize(("rate", "mie"), [(0.5, 9.76e-4), (1, 1.447e-3), (5, 3.61e-3)])
def test_extinction_of_snow(rate, mie):
    assert snow_extinction(rate, 905, medium="gunn-marshall") == pytest.approx(mie, rel=5e-3)


# Half to twice the visibility of Stallabrass's measurements, with which dry snow scatters from storm to storm
# (Rasmussen et al. 1999: a factor of 3 to 10).
@pytest.mark.parametrize(
    ("rate", "low", "high"), [(0.5, 800, 3200), (1, 500, 2000), (2.5, 270, 1000), (5, 170, 700)]
)
def test_visibility_in_snow_is_as_measured(rate, low, high):
    assert low < _visibility("snow", rate, WeatherSetting("snow", rate).medium) < high


def test_extinction_of_snow_by_stallabrass():
    """10.36 C^0.7776 1/km; 0.286 g/m^3 of water that fall with 0.97 m/s are 1 mm/h."""
    assert 1000 * snow_extinction(1, 905, medium="stallabrass") == pytest.approx(
        10.36 * 0.2856**0.7776, rel=1e-3
    )
    assert snow_extinction(3, 1550, medium="stallabrass") == snow_extinction(3, 550, medium="stallabrass")


@pytest.mark.parametrize("rate", [0.3, 1, 3, 10])
def test_flakes_have_the_extinction_the_water_and_the_lidar_ratio_of_snow(rate):
    air = snow(rate, 905, medium="stallabrass")
    area = air.number * np.pi / 4 * air.diameter**2
    assert 2 * area.sum() == pytest.approx(air.extinction, rel=1e-3)
    assert air.extinction / air.backscatter == pytest.approx(25, rel=1e-2)
    n0, slope = snow_slope(rate, "stallabrass")
    water = 1e-6 * np.pi * n0 / slope**4  # kg/m^3, of the melted flakes
    density = water / (np.pi / 6 * air.diameter**3 * air.number).sum()
    assert 20 < density < 120  # kg/m^3: dry snowflakes of some millimetres (Holroyd 1971: 170/D with D in mm)


def test_snow_is_dark_for_a_laser_of_1550_nm():
    assert (
        snow(2, 1550, medium="stallabrass").backscatter < 0.1 * snow(2, 905, medium="stallabrass").backscatter
    )


def test_extinction_of_snow_by_itu():
    def of(rate, medium):
        return DB_PER_KM * snow_extinction(rate, 905, medium=medium)

    found = [of(1, "itu-dry"), of(1, "itu-wet"), of(5, "itu-dry"), of(5, "itu-wet")]
    assert found == pytest.approx([5.54, 3.88, 51.1, 12.4], rel=4e-3)


def test_moderate_advection_fog_by_mie():
    extinction, ratio, water = droplet_optics("moderate-advection", 905)
    assert extinction == pytest.approx(0.01873, rel=0.02)
    assert droplet_optics("moderate-advection", 1550)[0] == pytest.approx(0.019111, rel=0.02)
    assert water == pytest.approx(0.1906, rel=0.01)
    assert 3.912 / extinction == pytest.approx(208.9, rel=0.02)
    assert 17 < ratio < 20


def test_lidar_ratios_of_droplets():
    names = ("strong-advection", "moderate-advection", "strong-spray", "moderate-spray", "chu-hogg")
    assert all(16.5 < droplet_optics(name, 905)[1] < 21 for name in names)
    assert droplet_optics("continental-haze", 905)[1] == pytest.approx(106, rel=0.02)


def test_a_droplet_distribution_gives_the_visibility():
    assert fog_extinction(300, 550, medium="chu-hogg") == pytest.approx(3.912 / 300)
    assert _visibility("fog", 300, "kim") == pytest.approx(300)
    assert 1000 < _visibility("rain", 20, "marshall-palmer") < 3000


def test_large_drops_send_back_less_at_1550_nm_where_water_absorbs():
    n = water_index(1550).real
    front = ((n - 1) / (n + 1)) ** 2
    assert drop_backscatter(4.0, 1550) == pytest.approx(front, rel=0.05)
    assert drop_backscatter(4.0, 905) > 4 * front
    # Of small, round drops it is Mie's.
    near = 0.1 * np.geomspace(0.9, 1.1, 400)
    assert drop_backscatter(0.1, 905) == pytest.approx(
        mie_efficiencies(np.pi * near / 905e-6, water_index(905))[2].mean(), rel=0.25
    )


@pytest.mark.full
@pytest.mark.parametrize("wavelength", [905, 1550])
def test_extinction_and_backscatter_grow_with_the_amount(wavelength):
    media = [rain(rate, wavelength) for rate in (0, 0.5, 5, 50)]
    media += [snow(rate, wavelength) for rate in (0, 0.5, 5, 50)]
    for some in (media[:4], media[4:]):
        assert np.all(np.diff([m.extinction for m in some]) > 0)
        assert np.all(np.diff([m.backscatter for m in some]) > 0)


def test_the_lidar_ratio_of_fog_depends_little_on_the_wavelength():
    assert fog_ratio(905) == pytest.approx(18, rel=0.1)
    fog = medium_of("fog", 100, wavelength_nm=905, medium="kim")
    assert fog.extinction / fog.backscatter == pytest.approx(fog_ratio(905))
