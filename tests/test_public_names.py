"""What `import geoscene` and `import lidar` give."""

import pytest

import geoscene
import lidar


@pytest.mark.parametrize("package", [geoscene, lidar])
def test_every_public_name_is_a_function_or_class_with_a_docstring(package):
    assert {"build", "open_scene"} <= set(geoscene.__all__)
    assert {"drive", "open_dataset"} <= set(lidar.__all__)
    for name in package.__all__:
        value = getattr(package, name)
        assert callable(value), name
        assert value.__doc__, name
