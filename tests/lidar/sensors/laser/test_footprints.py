"""Pulses with as many rays as their footprint needs have the echoes of pulses with very many rays."""

from contextlib import nullcontext
from dataclasses import fields

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, world

from geoscene.classes import Class
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.options.drive import DriveOptions
from lidar.sensors.laser.footprints import COUNTS
from lidar.sensors.laser.rays import bundle
from lidar.sensors.laser.scan import cast, measure, scan
from lidar.sensors.physics.settings import LEVELS, MOST_RAYS, ScannerSettings
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.settings import settings_of
from lidar.simulation.plan import plan_drive

GROUND = box((-150, -150, -1), (150, 150, 0), feature=1, klass=Class.ROAD, material="asphalt")
SENSOR, MOUNT, STILL = load_sensor("vlp16"), Mount((0.0, 0.0, 1.0)), driven((0.0, 0.0, 0.0))


def rows_of(cloud):
    """Ring and column of returns as one number, and their ranges."""
    return cloud.column.astype(np.int64) * 64 + cloud.ring, cloud.range


def compared(place, tolerance):
    """Errors of returns ahead against those of 999 rays, and the shares of missed and of extra returns."""
    ahead = np.flatnonzero(firings(SENSOR, 0).direction[:, 0] > 0.82)
    few, many = (
        rows_of(
            measure(
                cast(
                    SENSOR, MOUNT, trajectory=STILL, world=place, frame=0, seed=1, pulses=ahead, settings=one
                )
            )
        )
        for one in (ScannerSettings(footprint=tolerance), ScannerSettings(rays=MOST_RAYS))
    )
    _, a, b = np.intersect1d(few[0], many[0], return_indices=True)
    count = len(many[0])
    return np.abs(few[1][a] - many[1][b]), 1 - len(b) / count, (len(few[0]) - len(a)) / count


def pickets(apart, wide, *, away=12.0):
    return [
        box((away, y, 0), (away + wide, y + wide, 1.5), feature=10 + k, klass=Class.WALL)
        for k, y in enumerate(np.arange(-8.0, 8.0, apart))
    ]


@pytest.mark.parametrize("tolerance", [0.01, 0.03])
def test_houses_steps_and_fences_have_ranges_within_the_tolerance(tolerance):
    steps = [
        box((20 + 0.2 * k, -12 + 2 * k, 0), (30, -10 + 2 * k, 9), feature=40 + k, material="brick")
        for k in range(6)
    ]
    place = world(GROUND, *steps, *pickets(0.35, 0.06))
    error, missed, extra = compared(place, tolerance)
    assert len(error) > 3000
    assert np.mean(error > tolerance) < 0.004
    assert missed < 1e-3
    assert extra < 1e-4


@pytest.mark.parametrize("rays", COUNTS)
def test_the_share_of_a_disc_beyond_an_edge_errs_as_stated(rays):
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 300)
    across, edge = np.stack([np.cos(angle), np.sin(angle)]), rng.uniform(-1, 1, 300)
    few, many = (np.mean(bundle(n) @ across > edge, axis=0) for n in (rays, MOST_RAYS))
    assert np.sqrt(np.mean((few - many) ** 2)) < 0.3 * rays**-0.75


@pytest.mark.full
def test_smooth_ground_has_the_mean_range_of_a_gaussian_beam_down_to_grazing_angles():
    error, missed, extra = compared(world(GROUND), 0.01)
    assert error.max() < 2e-3
    assert missed == extra == 0


def test_poles_are_found_as_often_as_by_very_many_rays():
    poles = [
        box((25.0, y, 0), (25.03, y + 0.03, 6), feature=100 + k, klass=Class.POLE)
        for k, y in enumerate(np.arange(-12.0, 12.0, 0.9))
    ]
    _, missed, extra = compared(world(*poles), 0.01)
    assert missed < 0.08  # of returns of nothing but poles of 3 cm before the sky
    assert extra < 1e-3


def test_more_rays_are_cast_where_surfaces_meet_and_nowhere_else(monkeypatch):
    import lidar.sensors.laser.surface_echoes as module  # noqa: PLC0415

    counts = []
    trace = module._Tracer.echoes

    def counted(self, sample, *, rows=None, watch=None):
        counts.append((len(sample.place), len(self.pulses.firings) if rows is None else len(rows)))
        return trace(self, sample, rows=rows, watch=watch)

    monkeypatch.setattr(module._Tracer, "echoes", counted)
    settings = ScannerSettings(footprint=0.01)
    scan(SENSOR, MOUNT, trajectory=STILL, world=world(GROUND), frame=0, settings=settings)
    (probe,) = counts
    assert probe == (7, len(firings(SENSOR, 0)))
    counts.clear()
    place = world(GROUND, *pickets(0.35, 0.06))
    scan(SENSOR, MOUNT, trajectory=STILL, world=place, frame=0, settings=settings)
    (_, pulses), (rays, rough), *_ = counts
    assert rays > 7
    assert 0.001 < rough / pulses < 0.1


def test_a_frame_has_the_same_bytes_for_any_number_of_threads():
    place = world(GROUND, *pickets(0.35, 0.06))
    clouds = [
        scan(
            SENSOR, MOUNT, trajectory=driven((9.0, 0.0, 0.0)), world=place, frame=2, seed=5, threads=threads,
            settings=LEVELS["survey"].changed(footprint=0.02),
        )
        for threads in (1, 2)
    ]  # fmt: skip
    for f in fields(clouds[0]):
        np.testing.assert_array_equal(*(getattr(cloud, f.name) for cloud in clouds))


NOISE, STEPS = ("range_noise", "constant"), ("quantise", "on")


@pytest.mark.parametrize(
    ("footprint", "more", "formats", "message"),
    [
        ("0.5mm", (), "pcd laz", ""),
        ("0.5mm", (NOISE,), "pcd", "lidar_top has range noise of 1 cm, in which errors below 1 mm"),
        ("0.5mm", (STEPS,), "pcd", "lidar_top has steps of 2 mm, in which errors below 1 mm"),
        ("0.2mm", (), "laz", "files of laz have steps of 1 mm, in which errors below 500 µm"),
        ("0.2mm", (), "laz pcd", ""),
    ],
)
def test_a_tolerance_that_noise_or_steps_hide_is_refused(scene, footprint, more, formats, message):
    settings = (("footprint", footprint), *more)
    options = DriveOptions(
        route="random", rig="vlp16", duration=0.2, settings=settings, formats=tuple(formats.split())
    )
    with pytest.raises(InputError, match=message) if message else nullcontext():
        plan_drive(scene, options)


def test_some_pulses_of_a_frame_have_the_echoes_that_they_have_among_all():
    place, settings = world(GROUND, *pickets(0.35, 0.06)), ScannerSettings(footprint=0.01)
    some = np.arange(3, len(firings(SENSOR, 0)), 7)
    whole, part = (
        cast(SENSOR, MOUNT, trajectory=STILL, world=place, frame=0, pulses=pulses, settings=settings)
        for pulses in (None, some)
    )
    expected = whole.echoes.where(np.isin(whole.echoes.pulse, some))
    np.testing.assert_array_equal(some[part.echoes.pulse], expected.pulse)
    np.testing.assert_array_equal(part.echoes.range, expected.range)
    np.testing.assert_array_equal(part.firings.time_ns, whole.firings.time_ns[some])


def test_settings_take_lengths_and_replace_the_rays_of_a_level():
    for text in ("1cm", "10mm", "0.01", "0.01 m"):
        scanner, *_ = settings_of("survey", [("footprint", text)])
        assert (scanner.footprint, scanner.rays) == (0.01, 1)
    assert settings_of("survey", [("rays", "7")])[0].footprint == 0
    assert settings_of("survey", [("footprint", "0")])[0] == LEVELS["survey"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"footprint": "1cm", "rays": "7"}, "footprint and rays=7: give one of them"),
        ({"footprint": "0.01mm"}, r"below 0.0001 m, what ranges of float32 keep"),
        ({"footprint": "-1"}, "at least 0 m"),
        ({"footprint": "1 inch"}, "is not a number"),
        ({"footprint": "1cm", "stretch": "on"}, "stretch: has no effect with footprint"),
    ],
)
def test_tolerances_that_cannot_be_kept_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        settings_of("standard", given.items())
