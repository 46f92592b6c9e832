"""Options --weather and --attack: order, settings, recipe, and bad input."""

import pytest
from helpers.programs import run_program

from lidar.errors import InputError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.signal.attacks.inject import Inject
from lidar.signal.registry import NamedStage, read_attacks, read_stages
from lidar.signal.weather.setting import read_weather

LOSSY = read_stages(["dropped_packets:loss=0.1"]).stages


def test_weather_comes_first_then_attacks_then_other_stages():
    attacks = read_attacks(["inject:range=9", "inject"])
    options = DriveOptions(
        route="random", stages=LOSSY, attacks=attacks, weather=read_weather("rain=10mm/h,fog=50m")
    )
    stages = options.all_stages
    assert [s.name for s in stages] == ["weather", "weather", "inject", "inject", "dropped_packets"]
    assert [s.number for s in stages] == [0, 1, 0, 1, 0]
    assert [s.stage.kind for s in stages[:2]] == ["rain", "fog"]
    assert stages[2].stage.range == 9
    assert stages == ApplyOptions(LOSSY, weather=options.weather, attacks=attacks).all_stages


def test_weather_loses_weak_echoes_unless_the_user_says_otherwise():
    fog = read_weather("fog=50m")
    assert not DriveOptions(route="random").recording_settings.scanner.link
    assert DriveOptions(route="random", weather=fog).recording_settings.scanner.link
    off = DriveOptions(route="random", weather=fog, settings=(("link", "off"),))
    assert not off.recording_settings.scanner.link
    staged = DriveOptions(route="random", stages=read_stages(["weather:kind=fog,amount=9"]).stages)
    assert staged.recording_settings.scanner.link


@pytest.mark.parametrize(
    ("text", "cloud", "wetness", "snow"),
    [
        ("rain=3mm/h", 1, 0.65, 0),
        ("rain=40mm/h", 1, 1, 0),
        ("rain=0", 1, 0, 0),
        ("rain=3mm/h,wetness=0.1", 1, 0.1, 0),
        ("snow=2mm/h", 1, 0.3, 0.5),
        ("snow=2mm/h,snow_cover=0,wetness=0", 1, 0, 0),
        ("spray=0.6mm", 1, 0.5, 0),
        ("fog=50m", 1, 0, 0),
        ("clear,wetness=0.4,snow_cover=0.2", 0.3, 0.4, 0.2),
        ("rain=3mm/h,model=lisa", 0.3, 0, 0),
    ],
)
def test_weather_wets_the_ground_and_covers_the_sky_by_its_kind(text, cloud, wetness, snow):
    settings = DriveOptions(route="random", weather=read_weather(text)).recording_settings
    found = settings.camera.cloud, settings.world.wetness, settings.world.snow
    assert found == pytest.approx((cloud, wetness, snow))
    told = DriveOptions(
        route="random", weather=read_weather(text), settings=(("wetness", "0.9"),)
    ).recording_settings
    assert told.world.wetness == 0.9


def test_the_recipe_lists_weather_and_attacks_as_stages(scene):
    plain = DriveOptions(route="random").recipe(scene)
    assert not {"stages", "weather", "attacks"} & plain.keys()
    wanted = DriveOptions(
        route="random", weather=read_weather("rain=3mm/h"), attacks=read_attacks(["inject"])
    )
    recipe = wanted.recipe(scene)
    assert [row["name"] for row in recipe["stages"]] == ["weather", "inject"]
    assert recipe["stages"][0]["amount"] == 3
    assert recipe["settings"] == [["link", "on"], ["cloud", "1"], ["wetness", "0.65"]]
    assert not {"weather", "attacks"} & recipe.keys()


def test_a_value_of_an_attack_may_have_commas():
    (attack,) = read_attacks(["inject:place=40.7195,-73.9877,1.5,range=9"])
    assert (attack.stage.place, attack.stage.range) == ("40.7195,-73.9877,1.5", 9.0)
    with pytest.raises(InputError, match=r"range = '9,1\.5' is not a number"):
        read_attacks(["inject:range=9,1.5"])


def test_files_of_attacks_hold_attacks_only(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text('[[attack]]\nname = "inject"\nrange = 9\nsensor = "top"\n')
    assert read_attacks([str(file)]) == (NamedStage("inject", Inject(range=9), sensor="top"),)
    for text, match in (
        ('[[stage]]\nname = "inject"\n', r"give tables \[\[attack\]\]"),
        (
            '[[attack]]\nname = "dropped_packets"\n',
            r"attack 'dropped_packets' is unknown \(known are inject, ",
        ),
        ("[[attack]]\nrange = 9\n", r"a\.toml: \[\[attack\]\] 1: name is missing"),
        ("attack = []\n", r"give tables \[\[attack\]\]"),
        ('[[attack]]\nname = "inject"\nrange = -1\n', "range = -1 is not within"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=match):
            read_attacks([str(file)])
    with pytest.raises(InputError, match="range is given twice"):
        read_attacks(["inject:range=3,range=4"])
    with pytest.raises(InputError, match="give one or more of `stages`, `weather` and `attacks`"):
        ApplyOptions()


BAD = [
    ("--weather", "hail", "is unknown"),
    ("--weather", "rain=-1mm/h", "not within 0 to 300"),
    ("--weather", "fog", "needs an amount"),
    ("--weather", "none.toml", "cannot be read"),
    ("--attack", "blinding-laser", "is unknown"),
    ("--attack", "dropped_packets", "is unknown"),
    ("--attack", "none.toml", "cannot be read"),
]


@pytest.mark.full
@pytest.mark.parametrize(("flag", "text", "match"), BAD)
def test_bad_weather_and_attacks_end_in_one_line_with_nothing_written(scene, tmp_path, flag, text, match):
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "000000.bin").write_bytes(b"")
    file = tmp_path / "sweep.toml"
    file.write_text(f'[drive]\nscene = "{scene.path}"\nroute = "random"\n[grid]\n{flag[2:]} = ["{text}"]\n')
    route = ("--route", "random", "--duration", "0.5", flag, text)
    for words in (
        ("drive", scene.path, *route),
        ("apply", tmp_path, flag, text),
        ("sweep", file),
    ):
        result = run_program("lidar", *words, "-o", tmp_path / "out", "-q")
        assert result.returncode == 2, result.stderr
        assert result.stderr.count("\n") == 1
        assert result.stderr.startswith("lidar: ")
        assert match in result.stderr
        assert not (tmp_path / "out").exists()
