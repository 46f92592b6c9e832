"""Scenes on disk: layout, reading, writing and validation."""

from geoscene.scene.layout import Scene as Scene
from geoscene.scene.layout import SceneFiles as SceneFiles
from geoscene.scene.layout import SceneLike as SceneLike
from geoscene.scene.layout import open_scene as open_scene
