"""The scene on disk."""

from geoscene.scene.layout import Scene as Scene
from geoscene.scene.layout import open_scene as open_scene
