"""Parsing of tag values."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoscene.tags import parse_color, parse_direction, parse_length, parse_number

metres = st.decimals(min_value=0, max_value=2000, places=3).map(float)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("12", 12.0), ("48.5 m", 48.5), ("48.5m", 48.5), ("9,5", 9.5), ("5;6", 5.0), (";5", 5.0),
        ("~10", 10.0),
        ("ca. 7 m", 7.0), ("12'6\"", 150 * 0.0254), ("12' 6''", 150 * 0.0254), ("12′6″", 150 * 0.0254),
        ("5 ft 6 in", 66 * 0.0254), ("574'", 574 * 0.3048), ("6 ft", 6 * 0.3048), ('8"', 8 * 0.0254),
        ("1.2 km", 1200.0), ("250 cm", 2.5), ("1,234.5", 1234.5), ("1.234,5 m", 1234.5), ("-3", -3.0),
        ("2 storeys", None), ("high", None), ("", None), (None, None), ("1.2.3", None), ("10-12", None),
        ("1e3", None), ("nan", None), ("inf", None), ("12 m2", None), ("9" * 400, None),
    ],
)  # fmt: skip
def test_a_length_is_read_in_metres(text, expected):
    found = parse_length(text)
    assert found is None if expected is None else found == pytest.approx(expected, rel=1e-12)


@given(
    metres,
    st.sampled_from([("m", 1.0), ("", 1.0), ("km", 1000.0), ("ft", 0.3048), ("'", 0.3048), ("mi", 1609.344)]),
)
def test_units_spaces_and_decimal_commas_are_accepted(value, unit):
    name, size = unit
    for text in (
        f"{value}{name}",
        f"{value} {name}",
        f" {value} {name.upper()} ",
        f"{value}{name}".replace(".", ","),
    ):
        assert parse_length(text) == pytest.approx(value * size, rel=1e-12)


@given(st.integers(0, 3000), st.integers(0, 11))
def test_feet_and_inches_add_up(feet, inches):
    assert parse_length(f"{feet}'{inches}\"") == pytest.approx((12 * feet + inches) * 0.0254)
    assert parse_length(f"-{feet}'{inches}\"") == pytest.approx(-(12 * feet + inches) * 0.0254)


@given(st.text(max_size=20))
def test_any_text_gives_a_finite_value_or_none(text):
    for parse in (parse_length, parse_number, parse_direction):
        value = parse(text)
        assert value is None or math.isfinite(value)
    color = parse_color(text)
    assert color is None or (len(color) == 3 and all(0 <= c <= 255 for c in color))


@given(st.integers(-1000, 1000))
def test_a_plain_number_has_no_unit(value):
    assert parse_number(str(value)) == value
    assert parse_number(f"{value};7") == value
    assert parse_number(f"{value} m") is None


@given(st.floats(-1e4, 1e4))
def test_a_direction_is_a_bearing_below_360(degrees):
    found = parse_direction(f"{degrees:.3f}°")
    assert 0 <= found < 360
    assert math.cos(math.radians(found - degrees)) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("N", 0),
        ("e", 90),
        ("SW", 225),
        ("NNE", 22.5),
        ("north-west", 315),
        ("South", 180),
        ("up", None),
        (None, None),
    ],
)
def test_compass_points_are_bearings(text, expected):
    assert parse_direction(text) == expected


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_a_hex_colour_is_its_bytes(rgb):
    text = "{:02x}{:02X}{:02x}".format(*rgb)
    assert parse_color(f"#{text}") == parse_color(text) == rgb
    assert parse_color("rgb({}, {}, {})".format(*rgb)) == rgb


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("red", (255, 0, 0)), ("light grey", (211, 211, 211)), ("Dark_Red", (139, 0, 0)),
        ("#fa0", (255, 170, 0)), ("ca0000", (202, 0, 0)), ("CA5", (204, 170, 85)), ("ca. 7 m", None),
        ("white;red", (255, 255, 255)), ("multicolour", None), ("#12", None), (None, None), ("", None),
    ],
)  # fmt: skip
def test_colour_names_are_css(text, expected):
    assert parse_color(text) == expected
