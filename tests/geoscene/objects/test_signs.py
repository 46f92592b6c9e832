"""Faces of traffic signs from tags."""

import pytest

from geoscene.objects.furniture import shape_of
from geoscene.objects.shapes import shapes
from geoscene.objects.signs import select_direction, sign_codes, sign_face, sign_shape


@pytest.mark.parametrize(
    ("tags", "face"),
    [
        ({"traffic_sign": "DE:274-30"}, "limit 30"),
        ({"traffic_sign": "DE:274[70]"}, "limit 70"),
        ({"traffic_sign": "DE:274", "maxspeed": "50"}, "limit 50"),
        ({"traffic_sign": "DE:274"}, "limit"),
        ({"traffic_sign": "DE:262[5.5]"}, "limit 5.5t"),
        ({"traffic_sign": "DE:240,DE:1022-11"}, "path both"),
        ({"traffic_sign": "DE:260;DE:1026-37"}, ""),
        ({"traffic_sign": "DE:209-10"}, "ahead left"),
        ({"traffic_sign": "FI:363[40]"}, "zone 40"),
        ({"traffic_sign": "FR:B14", "maxspeed": "80"}, "limit 80"),
        ({"traffic_sign": "US:R1-1"}, "stop"),
        ({"traffic_sign": "US:R2-1", "maxspeed": "25 mph"}, "words SPEED LIMIT 25"),
        ({"traffic_sign": "BR:R-19[60]"}, "limit 60"),
        ({"traffic_sign": "maxspeed", "maxspeed": "30 mph"}, "limit 30"),
        ({"traffic_sign": "city_limit[CAP D'AIL]"}, "city CAP D'AIL"),
        ({"traffic_sign": "city_limit", "name": "Vaduz"}, "city Vaduz"),
        ({"traffic_sign": "street_name_sign", "name": "Rue  Grimaldi"}, "street Rue Grimaldi"),
        ({"traffic_sign": "XX:1"}, ""),
        ({"traffic_sign": "DE:"}, ""),
        ({"traffic_sign": "[]"}, ""),
        ({}, ""),
    ],
)
def test_tags_tell_what_is_drawn(tags, face):
    assert sign_face(tags) == face


def test_the_form_of_a_plate_follows_from_its_face_with_relief_alone():
    no_entry = {"traffic_sign": "DE:267"}
    assert shape_of(no_entry) == "sign_rectangle"
    assert shape_of(no_entry, relief="plain") == "sign_round"
    assert shape_of({"traffic_sign": "US:R1-1"}, relief="plain") == "sign_stop"
    assert shape_of({"traffic_sign": "XX:1"}, relief="full") == "sign_rectangle"
    faces = {face for country in sign_codes().values() for face in country.values()}
    assert {sign_shape(face) for face in faces} <= shapes().keys()


def test_a_sign_for_one_direction_counts_for_that_direction():
    tags = {"traffic_sign:forward": "maxspeed", "maxspeed:forward": "50", "highway": "x"}
    assert sign_face(select_direction(tags)) == "limit 50"
    assert select_direction(tags)["traffic_sign:direction"] == "forward"
    both = {**tags, "traffic_sign:backward": "maxspeed"}
    assert select_direction(both) is both
