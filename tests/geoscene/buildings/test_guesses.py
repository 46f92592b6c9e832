"""Guessed looks depend on the building alone, follow its region's shares, and keep to what is tagged."""

import numpy as np
import pytest
import tzfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.buildings.guesses import KINDS, WINDOWS, guess_looks, palettes, region_at

REGIONS = sorted(palettes()["regions"])

BUILDINGS = st.lists(
    st.tuples(
        st.integers(1, 10**10),
        st.sampled_from(
            ["yes", "house", "apartments", "office", "garage", "church", "industrial", "retail", "odd"]
        ),
        st.floats(1.0, 30_000.0),
        st.floats(0.0, 300.0),
        st.one_of(st.just(np.nan), st.floats(0.0, 100.0)),
        st.sampled_from([0.0, 2.5]),
    ),
    max_size=30,
)


def guessed(buildings, region="central_europe"):
    """Looks of (number, use, area, walls, levels, roof height)."""
    number, use, area, walls, levels, roof = (
        (list(c) for c in zip(*buildings, strict=True)) if buildings else [[]] * 6
    )
    return guess_looks(
        np.array([f"way/{n}" for n in number], object),
        np.array(use, object),
        area=np.array(area, float),
        walls=np.array(walls, float),
        levels=np.array(levels, float),
        roof_height=np.array(roof, float),
        region=region,
    )


def houses(count, *, use="house", area=120.0, walls=6.0, levels=np.nan, roof=0.0):
    return [(k + 1, use, area, walls, levels, roof) for k in range(count)]


@pytest.mark.full
@settings(max_examples=60, deadline=None)
@given(BUILDINGS, st.sampled_from(REGIONS), st.randoms(use_true_random=False))
def test_a_look_depends_on_the_building_and_its_region_alone(buildings, region, random):
    order = list(range(len(buildings)))
    random.shuffle(order)
    order = order[: len(order) // 2 + 1]
    whole, some = guessed(buildings, region), guessed([buildings[k] for k in order], region)
    for name, column in some.columns().items():
        assert np.array_equal(column, getattr(whole, name)[order]), name


@settings(max_examples=60, deadline=None)
@given(BUILDINGS, st.sampled_from(REGIONS))
def test_a_look_has_a_known_kind_storeys_and_colours_near_its_palette_s(buildings, region):
    looks, tables = guessed(buildings, region), palettes()
    assert set(looks.kind) <= set(KINDS)
    assert ((looks.windows >= 0) & (looks.windows < len(WINDOWS))).all()
    assert ((looks.storeys >= 1) & (looks.storeys <= 255)).all()
    for names, colors, palette in (
        (looks.wall, looks.wall_color, tables["walls"]),
        (looks.roof, looks.roof_color, tables["roofs"]),
    ):
        for name, color in zip(names, colors.astype(float), strict=True):
            ratio = np.array([color / np.array(one) for one in palette[name]])
            assert (np.abs(ratio - 1.0).max(axis=1) < 0.08).any()
    tall = np.array([row[5] > 0 for row in buildings], bool)
    assert looks.pitched[tall].all()


@pytest.mark.parametrize("region", REGIONS)
def test_names_of_a_region_are_in_the_palettes_and_shares_are_shares(region):
    table = palettes()["regions"][region]
    for place, names in (("low", "walls"), ("tall", "walls"), ("pitched", "roofs"), ("flat", "roofs")):
        assert set(table[place]) <= set(palettes()[names])
        assert min(table[place].values()) > 0
    assert 0 <= table["pitched_tall"] <= table["pitched_low"] <= 1
    assert 0 <= table["hipped"] <= 1
    assert 10 <= table["pitch_deg"] <= 50


def test_looks_are_as_frequent_as_the_region_s_weights():
    region = palettes()["regions"]["north_america"]
    looks = guessed(houses(4000), "north_america")
    assert not looks.pitched.any()
    total = sum(region["low"].values())
    for name, weight in region["low"].items():
        assert (looks.wall == name).mean() == pytest.approx(weight / total, abs=0.03)
    for name, weight in region["flat"].items():
        assert (looks.roof == name).mean() == pytest.approx(weight / sum(region["flat"].values()), abs=0.03)


def test_tagged_storeys_are_kept_and_others_have_usual_heights():
    assert guessed(houses(3, use="apartments", walls=30.0, levels=4)).storeys.tolist() == [4, 4, 4]
    for use, walls in (("apartments", 30.0), ("office", 90.0), ("house", 6.0), ("industrial", 9.0)):
        storey = walls / guessed(houses(3, use=use, walls=walls)).storeys
        assert ((storey > 2.3) & (storey < 6.0)).all(), use


def test_kinds_follow_the_use_or_else_the_size():
    rows = [
        (1, "garage", 200.0, 8.0, np.nan, 0.0),
        (2, "church", 200.0, 20.0, np.nan, 0.0),
        (3, "yes", 20.0, 3.0, np.nan, 0.0),
        (4, "yes", 100.0, 7.0, np.nan, 0.0),
        (5, "yes", 400.0, 18.0, np.nan, 0.0),
        (6, "yes", 5000.0, 10.0, np.nan, 0.0),
        (7, "yes", 900.0, 80.0, np.nan, 0.0),
    ]
    looks = guessed(rows)
    assert looks.kind.tolist() == ["small", "sacred", "small", "low", "tall", "hall", "office"]
    windows = [WINDOWS[k] for k in looks.windows]
    assert windows[:3] == ["none", "tall", "none"]
    assert windows[5] == "strip under the roof"


@pytest.mark.parametrize(
    ("place", "region"),
    [
        ((-73.98, 40.72), "north_america"),
        ((8.7, 49.4), "central_europe"),
        ((9.84, 46.5), "alps"),
        ((7.42, 43.73), "mediterranean"),
        ((2.35, 48.85), "central_europe"),
        ((10.68, 59.92), "nordic"),
        ((-0.1, 51.5), "british_isles"),
        ((4.9, 52.37), "low_countries"),
        ((37.6, 55.8), "eastern_europe"),
        ((-51.2, -30.03), "latin_america"),
        ((103.86, 1.28), "asia"),
        ((139.7, 35.7), "east_asia"),
        ((46.7, 24.7), "arid"),
        ((36.8, -1.3), "africa"),
        ((151.2, -33.9), "oceania"),
        ((-30.0, 10.0), "other"),
        ((-182.0, -17.8), "oceania"),
    ],
)
def test_places_are_in_their_regions(place, region):
    assert region_at(*place) == region


def test_every_time_zone_on_land_has_a_region_of_its_own_continent():
    starts = {start for region in palettes()["regions"].values() for start in region["zones"]}
    named = [zone for zone in tzfpy.timezonenames() if not zone.startswith("Etc/")]
    lost = [z for z in named if not any(start and z.startswith(start) for start in starts)]
    assert {zone.partition("/")[0] for zone in lost} <= {"Atlantic"}  # islands between the regions


@pytest.mark.parametrize("region", REGIONS)
def test_a_roof_that_is_mapped_as_flat_is_not_covered_like_a_pitched_one(region):
    assert not guessed(houses(200, roof=0.0), region).pitched.any()
    assert guessed(houses(200, roof=2.5), region).pitched.all()
