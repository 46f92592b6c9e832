import pytest
from helpers import ROOT

from lidar.errors import InputError
from lidar.signal.registry import read_stage
from lidar.signal.weather.setting import KINDS, WeatherSetting, read_weather


def test_texts_give_kind_and_amount_in_its_unit():
    def amounts(text):
        stages = [named.stage for named in read_weather(text)]
        return [(w.kind, w.amount, w.model, w.medium) for w in stages]

    assert amounts("rain:amount=10mm/h") == amounts("rain=10mm/h")
    assert amounts("rain=10mm/h") == [("rain", 10, "physical", "marshall-palmer")]
    assert amounts("fog=0.2km,medium=radiation") == [("fog", 200, "physical", "radiation")]
    assert amounts("snow=2,model=hahner_snow,fog=500m") == [
        ("snow", 2, "hahner_snow", "gunn-marshall"),
        ("fog", 500, "physical", "kim"),
    ]
    assert amounts("dust,spray") == [("dust", 20, "physical", "plumes"), ("spray", 1, "physical", "plumes")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hail=3", "kind 'hail' is unknown (known are rain, fog, snow"),
        ("", "give NAME:KEY=VALUE"),
        ("rain", "rain needs an amount"),
        ("rain=-1", "amount = -1 mm/h of rain is not within 0 to 300"),
        ("rain=nan", "'nan' of rain is not a number"),
        ("fog=1mm/h", "'1mm/h' of fog is not a number in m or km"),
        ("fog=inf", "'inf' of fog is not a number"),
        ("rain=3,model=hahner_fog", "model hahner_fog has no rain; rain has physical, lisa, goodin"),
        ("fog=50m,medium=kym", "medium = 'kym' of fog is none of kim, kruse"),
        ("rain=3,wind=x", "wind = 'x' is not a number"),
        ("rain=3,gust=5", "parameter 'gust' is unknown (known are kind, amount"),
        ("rain=3,wnd=5", "is wind meant?"),
        ("rain=3,start=9,end=4", "end = 4 is not after start = 9"),
        ("rain=3,amount_to=4", "amount_to needs an end"),
        ("clear=3", "amount = 3 of clear is not 0: it has no amount"),
        ("rain=3,wind=1,wind=2", "wind is given twice"),
        ("fog=50m,radius=10", "a centre needs longitude, latitude and radius; latitude is missing"),
        ("fog=50m,longitude=7,latitude=50", "radius is missing"),
        ("fog=50m,edge=10", "edge belongs to a place"),
        ("nowhere.toml", "nowhere.toml: cannot be read as TOML"),
    ],
)
def test_bad_texts_say_what_is_wrong(text, message):
    with pytest.raises(InputError) as error:
        read_weather(text)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_files_have_weather_over_time_and_place(tmp_path):
    path = tmp_path / "day.toml"
    path.write_text(
        """
        [[weather]]
        kind = "rain"
        amount = "5mm/h"
        amount_to = 20
        from = 10
        to = 20
        interpolation = "linear"

        [[weather]]
        kind = "fog"
        amount = 100
        polygon = [[7.0, 50.0], [7.1, 50.0], [7.1, 50.1]]

        [[weather]]
        kind = "dust"
        centre = [7.05, 50.05]
        radius = 300.0
        """
    )
    rain, fog, dust = (named.stage for named in read_weather(str(path)))
    assert [rain.amount_at(t) for t in (9.9, 10, 15, 20)] == [None, 5, 12.5, None]
    assert fog.corners() == [(7.0, 50.0), (7.1, 50.0), (7.1, 50.1)]
    assert (dust.longitude, dust.latitude, dust.radius) == (7.05, 50.05, 300)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('amount = "5mm/h"', "[[weather]] 1: kind is missing"),
        ('kind = "rain"', "[[weather]] 1: rain needs an amount"),
        ('kind = "fog"\namount = 9\ncentre = [7.0, 50.0]', "with a radius in metres"),
        ('kind = "fog"\namount = 9\npolygon = [[7.0, 50.0], [7.1]]', "polygon is [[longitude, latitude]"),
        ('kind = "fog"\namount = 9\npolygon = "0 0, 1 1, 1 0, 0 1"', "its sides may not cross"),
        ('kind = "fog"\namount = 9\ninterpolation = "cubic"', "interpolation is step, or linear"),
        ('kind = "fog"\namount = nan', "amount = nan is not a finite number"),
        (
            'kind = "fog"\namount = 9\nfog = 3',
            "parameter 'fog' is unknown (known are kind, amount, amount_to, start, end",
        ),
    ],
)
def test_bad_files_name_the_table(tmp_path, table, message):
    path = tmp_path / "bad.toml"
    path.write_text(f"[[weather]]\n{table}\n")
    with pytest.raises(InputError) as error:
        read_weather(str(path))
    assert str(error.value).startswith(str(path))
    assert message in str(error.value)


def test_the_extinction_of_changing_fog_is_linear_in_time():
    fog = WeatherSetting(kind="fog", amount=100.0, amount_to=50.0, start=0.0, end=10.0)
    assert 1 / fog.amount_at(5) == pytest.approx((1 / 100 + 1 / 50) / 2)


@pytest.mark.parametrize("kind", KINDS)
def test_a_stage_is_made_again_from_its_table(kind):
    amount = KINDS[kind].default if KINDS[kind].default is not None else 8.0
    (named,) = read_weather(f"{kind}={amount:g},wind=3")
    assert named.name == "weather"
    assert read_stage(named.to_json()) == named
    assert named.stage.wind == 3


def test_the_example_is_a_morning():
    path = ROOT / "examples" / "weather" / "morning.toml"
    settings = [named.stage for named in read_weather(str(path))]
    assert [s.kind for s in settings] == ["fog", "rain", "rain"]
    now = [[s.kind for s in settings if s.amount_at(t) is not None] for t in (0, 299, 300, 600, 900, 5000)]
    assert now == [["fog"], ["fog"], ["rain"], ["rain"], ["rain"], ["rain"]]
