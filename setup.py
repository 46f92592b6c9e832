"""Puts the demo extract into the package; all else stands in pyproject.toml."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithDemo(build_py):
    """Copies ``data/*.osm.pbf`` to ``geoscene/demo`` in wheels; a checkout reads it from ``data``."""

    def run(self) -> None:
        """Build, then copy, unless the checkout itself is installed."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "geoscene" / "demo"
            target.mkdir(parents=True, exist_ok=True)
            for file in sorted(Path("data").glob("*.osm.pbf")):
                self.copy_file(str(file), str(target / file.name))


setup(cmdclass={"build_py": BuildWithDemo})
