"""The site of the documentation loads nothing from elsewhere, and has all options as the programs do."""

import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest
from helpers import ROOT
from helpers.programs import ENVIRONMENT

import geoscene.cli
import lidar.cli
from lidar.sensors.rig.devices import rig_names, sensor_names


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Folder of the site; its build fails for broken links and anchors, and pages that no menu has."""
    folder = tmp_path_factory.mktemp("site")
    words = ["-m", "mkdocs", "build", "--strict", "--site-dir", folder, "--config-file", ROOT / "mkdocs.yml"]
    env = ENVIRONMENT | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run([sys.executable, *words], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


class Loaded(HTMLParser):
    """Addresses that a page loads without a click."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag != "a" and not (tag == "link" and attributes.get("rel") in ("canonical", "prev", "next")):
            self.addresses += [attributes[name] for name in ("src", "href") if attributes.get(name)]


def test_pages_load_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text("utf-8"))
        assert loaded.addresses
        for address in loaded.addresses:
            assert not re.match(r"(https?:)?//", address), (page, address)
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", sheet.read_text("utf-8")), sheet


@pytest.mark.parametrize(("program", "app"), [("geoscene", geoscene.cli.app), ("lidar", lidar.cli.app)])
def test_the_reference_has_every_command_with_its_options(site, program, app):
    text = (site / "reference" / f"{program}.html").read_text("utf-8")
    for name in app:
        if name.startswith("-"):
            continue
        found = re.search(rf'<h2 id="{program}-{name}">.*?(?=<h2 |</article>)', text, re.DOTALL)
        assert found, name
        for argument in app[name].assemble_argument_collection():
            if argument.show and argument.names and argument.names[0].startswith("--"):
                assert f"{argument.names[0]}" in found[0], (name, argument.names)


def test_the_reference_lists_all_sensors_and_rigs(site):
    text = (site / "reference" / "choices.html").read_text("utf-8")
    for name in (*sensor_names(), *rig_names()):
        assert re.search(rf"\b{name}\b", text), name


@pytest.mark.gate
def test_links_of_the_repositorys_pages_lead_to_files():
    """On a repository host, where README and the others are read as they are."""
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        prose = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", prose):
            if not target.startswith(("http:", "https:")):
                assert (page.parent / target).exists(), (page, target)


def test_lists_and_tables_are_those_of_repository_hosts(site):
    """A page has as many list items, table rows and blocks of code as its Markdown."""
    for source in (ROOT / "docs").rglob("*.md"):
        text = source.read_text("utf-8")
        html = (site / source.relative_to(ROOT / "docs").with_suffix(".html")).read_text("utf-8")
        article = re.search(r"<article.*?</article>", html, re.DOTALL)[0]
        fences = len(re.findall(r"^\s*```", text, re.MULTILINE)) // 2
        prose = re.sub(r"^\s*```.*?^\s*```", "", text, flags=re.DOTALL | re.MULTILINE)
        items = len(re.findall(r"^ *(?:[-*]|\d+\.) ", prose, re.MULTILINE))
        rows = len(re.findall(r"^ *\|(?!-|:)", prose, re.MULTILINE))
        assert article.count("<li>") == items, source
        assert article.count("<tr>") == rows, source
        assert article.count("<pre") >= fences, source
