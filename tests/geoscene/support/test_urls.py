"""Secrets of addresses: users, passwords, keys and tokens."""

import pytest
from helpers.programs import run_program

from geoscene.scene.layout import Scene
from geoscene.support.storage import StoredFolder, shown
from geoscene.support.urls import redacted, without_secrets


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("https://me:pw@host:81/a?b=1", "https://host:81/a?b=1"),
        ("https://token@host/a", "https://host/a"),
        ("s3:/key:secret@bucket/name", "s3:/bucket/name"),
        ("https://me:p@w@host/a", "https://host/a"),
        ("https://host/{z}/{x}/{y}.png?key=abc&style=2", "https://host/{z}/{x}/{y}.png?key=***&style=2"),
        (
            "https://b.s3.amazonaws.com/x?X-Amz-Credential=A%2Fb&X-Amz-Signature=1f&X-Amz-Expires=60",
            "https://b.s3.amazonaws.com/x?X-Amz-Credential=***&X-Amz-Signature=***&X-Amz-Expires=***",
        ),
        ("https://h/x?sv=2020&sig=a%3D&api_key=1&access_token=t", "https://h/x?sv=2020&sig=***&api_key=***&access_token=***"),
        ("two: ftp://a:b@c/d and https://e:f@g?password=h!", "two: ftp://c/d and https://g?password=***"),
        ("/home/me@work/map.osm", "/home/me@work/map.osm"),
        ("dror:angle=0.2,neighbours=5", "dror:angle=0.2,neighbours=5"),
        ("someone@example.org", "someone@example.org"),
    ],
)  # fmt: skip
def test_addresses_lose_users_and_the_values_of_secret_parameters(text, expected):
    assert without_secrets(text) == expected
    assert redacted({"a": [text, 1, {"b": (text,)}]}) == {"a": [expected, 1, {"b": [expected]}]}


def test_scenes_and_folders_in_storage_are_named_without_secrets():
    stored = StoredFolder("s3://key:secret@bucket/scene")
    assert stored.name == "s3://bucket/scene"
    assert stored.url.startswith("s3://key:secret@")  # which is what opens it
    assert shown("s3:/key:secret@bucket/scene") == "s3://bucket/scene"
    assert Scene("cache", {}, None, stored).location == "s3://bucket/scene"


def test_errors_of_storage_and_servers_do_not_show_secrets(tmp_path):
    osm = tmp_path / "map.osm"
    osm.write_text("<osm/>")
    for words in (
        ["build", "--osm", osm, "-o", "nothing://key:pa55word@bucket/scene?token=pa55word"],
        ["info", "nothing://key:pa55word@bucket/scene?token=pa55word"],
        ["build", "--place", "a", "--nominatim", "http://me:pa55word@127.0.0.1:9?key=pa55word", "-o", "s"],
        ["export", "scene", "-o", "s3://key:pa55word@bucket/scene.glb"],
    ):  # fmt: skip
        done = run_program("geoscene", *words)
        assert done.returncode in (1, 2)
        assert "pa55word" not in done.stdout + done.stderr
        assert done.stderr.count("\n") == 1
