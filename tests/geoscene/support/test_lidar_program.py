"""The program ``lidar`` beside an unrelated package of the same module name."""

import subprocess
import sys
from pathlib import Path

import pytest
from helpers.programs import ENVIRONMENT

import geoscene
from geoscene.errors import InputError
from geoscene.support.lidar_program import check_lidar

RUN = "from geoscene.support.lidar_program import main; main()"


def test_unrelated_lidar_module_found_first_is_reported_in_one_line(tmp_path):
    (tmp_path / "lidar").mkdir()
    (tmp_path / "lidar" / "__init__.py").write_text('"""Lakes and depressions."""\n')
    code = f"import sys; sys.path.append({str(Path(geoscene.__file__).parents[1])!r}); {RUN}"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert str(tmp_path) in done.stderr
    assert "pip uninstall lidar" in done.stderr


def test_unrelated_lidar_module_installed_over_ours_is_reported(tmp_path, monkeypatch):
    check_lidar()
    for package in ("geoscene", "lidar"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text('"""Lakes and depressions."""\n')
    monkeypatch.setattr(
        "geoscene.support.lidar_program.__file__", str(tmp_path / "geoscene" / "support" / "lidar_program.py")
    )
    monkeypatch.setattr(
        "geoscene.support.lidar_program.find_spec",
        lambda name: type("Spec", (), {"origin": str(tmp_path / name / "__init__.py")}),
    )
    with pytest.raises(InputError, match="unrelated package"):
        check_lidar()


@pytest.mark.parametrize("package", ["geoscene", "lidar"])
def test_packages_run_as_modules(package):
    command = [sys.executable, "-m", package, "--version"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"{geoscene.__version__}\n")
