"""Texts NAME:key=value,key=value and TOML tables of things with parameters, and their declarations."""

import re
from dataclasses import asdict, dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoscene.support.registry import Registry
from lidar.errors import InputError
from lidar.parameters import (
    Item,
    Parameters,
    build,
    item_text,
    parameter,
    parameter_rows,
    read_items,
    read_values,
    split_items,
    split_pairs,
)
from lidar.signal.registry import STAGES
from lidar.tools.defences.registry import DEFENCES
from lidar.tools.denoise.filters import METHODS

NAMES = ("fog", "rain", "wall")


@dataclass(frozen=True)
class Fog(Parameters):
    """A thing with a parameter of each kind."""

    share: float = parameter(0.5, "share", low=0, high=1)
    sight: float = parameter(50.0, "visibility", unit="m", low=1, endless="unlimited")
    shift: float = parameter(0.0, "shift", unit="m")
    count: int = parameter(3, "count", low=1, high=9)
    lit: bool = parameter(default=True, meaning="lit")
    law: str = parameter("kim", "law", among=("kim", "kruse"))
    place: str = parameter("", "place")


THINGS = Registry("thing", {"fog": Fog}, error=InputError)


def items(text, **options):
    return [(item.name, item.values) for item in split_items(text, NAMES, **options)]


def test_a_text_has_names_each_with_its_parameters():
    assert items("fog") == [("fog", {})]
    assert items("fog:share=0.2,law=kim") == [("fog", {"share": "0.2", "law": "kim"})]
    assert items(" fog : share = 0.2 , wall ") == [("fog", {"share": "0.2"}), ("wall", {})]
    assert items("fog,share=0.2,rain:a=1") == [("fog", {"share": "0.2"}), ("rain", {"a": "1"})]
    assert items("FOG:key=/a/B.key") == [("fog", {"key": "/a/B.key"})]


def test_values_may_have_commas_and_colons():
    assert items("fog:place=47.1, 8.5,1.5,share=1") == [("fog", {"place": "47.1,8.5,1.5", "share": "1"})]
    assert items("fog:device=cuda:0") == [("fog", {"device": "cuda:0"})]


def test_names_may_have_a_main_value_and_be_left_out():
    assert items("rain=3,wind=2,fog=50m", main="amount") == [
        ("rain", {"amount": "3", "wind": "2"}),
        ("fog", {"amount": "50m"}),
    ]
    assert items("share=1,count=2", default="fog") == [("fog", {"share": "1", "count": "2"})]
    assert split_pairs("rays=7,device=cuda:1") == [("rays", "7"), ("device", "cuda:1")]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "give NAME:KEY=VALUE,KEY=VALUE"),
        ("share=1", "share=1: give NAME:KEY=VALUE,KEY=VALUE"),
        ("fog:share", "fog:share: give NAME:KEY=VALUE"),
        ("fog:share=", "share has no value"),
        ("fog:=3", "3 has no key"),
        ("fog:share=1,share=2", "share is given twice"),
        ("fog:share=1:count=2", "separate parameters by commas, as in fog:share=1,count=2"),
        ("fog:share=1:count=2:lit=on", "as in fog:share=1,count=2,lit=on"),
    ],
)
def test_texts_of_another_form_are_refused_with_what_to_write(text, says):
    with pytest.raises(InputError, match=re.escape(says)):
        items(text)


@pytest.mark.parametrize("text", ["rays", "a:rays=7", "", "rays=7,rays=9"])
def test_pairs_of_another_form_are_refused(text):
    with pytest.raises(InputError):
        split_pairs(text)


def test_tables_of_a_file_say_the_same_as_texts(tmp_path):
    file = tmp_path / "fog.toml"
    file.write_text('[[thing]]\nname = "fog"\nshare = 0.2\nlit = false\n')
    (table,) = read_items([str(file)], THINGS, table="thing")
    (text,) = read_items(["fog:share=0.2,lit=off"], THINGS, table="thing")
    assert build(THINGS, table) == build(THINGS, text) == Fog(share=0.2, lit=False)
    for wrong, says in (
        ("[[thing]]\nshare = 1", "[[thing]] 1: name is missing"),
        (
            '[[thing]]\nname = "fog"\nshare = 2',
            "[[thing]] 1: thing fog: share = 2 is not within 0 to 1",
        ),
        ('[[other]]\nname = "fog"', "give tables [[thing]]"),
        ("[[thing", "cannot be read as TOML"),
    ):
        file.write_text(wrong)
        with pytest.raises(InputError, match=re.escape(says)) as error:
            [build(THINGS, item) for item in read_items([str(file)], THINGS, table="thing")]
        assert str(error.value).startswith(str(file))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fgo", "thing 'fgo' is unknown; is fog meant? (known are fog)"),
        ("fog:shar=1", "thing fog: parameter 'shar' is unknown; is share meant? (known are share, sight"),
        ("fog:share=2", "share = 2 is not within 0 to 1"),
        ("fog:share=nan", "share = nan is not within 0 to 1"),
        ("fog:sight=0", "sight = 0 is not at least 1 m, or unlimited"),
        ("fog:shift=inf", "shift = inf is not a finite number"),
        ("fog:count=2.5", "count = '2.5' is not a whole number within 1 to 9"),
        ("fog:lit=maybe", "lit = 'maybe' is not on or off"),
        ("fog:law=krus", "law = 'krus' is none of kim, kruse; is kruse meant?"),
        ("fog:share=2,count=0", "share = 2 is not within 0 to 1; count = 0 is not"),
    ],
)
def test_errors_name_parameter_value_and_what_is_allowed(text, says):
    with pytest.raises(InputError, match=re.escape(says)):
        [build(THINGS, item) for item in split_items(text, THINGS)]


def test_values_of_another_type_are_refused():
    for values in ({"share": "much"}, {"count": 2.0}, {"count": True}, {"lit": 1}, {"place": 3}):
        with pytest.raises(InputError):
            Fog(**values)
    assert Fog(share=1, sight=float("inf")).share == 1


@pytest.mark.parametrize("word", ["unlimited", "never", "Unlimited", "inf"])
def test_infinity_has_words_where_it_is_allowed(word):
    (fog,) = (build(THINGS, item) for item in split_items(f"fog:sight={word}", THINGS))
    assert fog.sight == float("inf")
    (row,) = (row for row in parameter_rows(type(Fog(sight=1.0))) if row["name"] == "sight")
    assert row["default"] == 50.0
    with pytest.raises(InputError, match="share"):
        [build(THINGS, item) for item in split_items(f"fog:share={word}", THINGS)]


WORDS = (
    st.text("abcdefghij /.-_0123456789", min_size=1)
    .map(str.strip)
    .filter(lambda word: word not in ("", "fog"))
)


@given(
    st.builds(
        Fog,
        share=st.floats(0, 1),
        sight=st.floats(1),
        shift=st.floats(allow_nan=False, allow_infinity=False),
        count=st.integers(1, 9),
        lit=st.booleans(),
        law=st.sampled_from(["kim", "kruse"]),
        place=st.lists(WORDS, min_size=1, max_size=3).map(",".join),
    )
)
def test_text_and_table_are_made_again_from_each_other(thing):
    text = item_text(Item("fog", asdict(thing)))
    (item,) = split_items(text, THINGS)
    assert build(THINGS, item) == thing
    assert item_text(Item("fog", read_values(Fog, item.values))) == text


@pytest.mark.parametrize("registry", [STAGES, DEFENCES, METHODS])
def test_every_parameter_declares_its_meaning_and_a_default_within_its_bounds(registry):
    for kind in registry.values():
        assert kind() == kind(
            **read_values(kind, {row["name"]: row["default"] for row in parameter_rows(kind)})
        )
        assert all(row["meaning"] for row in parameter_rows(kind))
