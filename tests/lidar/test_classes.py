"""Codes of classes and materials: in the program's list and in the documentation."""

import json
import subprocess

from helpers import ROOT
from helpers.programs import ENVIRONMENT, command

from geoscene.classes import Class, class_rows, materials

DOCUMENT = ROOT / "docs" / "reference" / "classes.md"


def test_every_class_and_material_is_documented_with_its_codes():
    text = DOCUMENT.read_text("utf-8")
    for row in class_rows():
        assert f"| {' | '.join(map(str, row.values()))} |\n" in text
    for material in materials().values():
        assert f"| {material.name} | {material.code} |\n" in text


def test_the_program_lists_classes_and_materials():
    program = command("lidar", "classes", "--json")
    done = subprocess.run(program, env=ENVIRONMENT, check=True, capture_output=True, text=True)
    listed = json.loads(done.stdout)
    assert {row["name"]: row["code"] for row in listed["classes"]} == {k.name.lower(): int(k) for k in Class}
    assert listed["materials"] == {m.name: m.code for m in materials().values()}
