"""A real place from OpenStreetMap as a watertight 3D scene in a projected frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene.support.registry import lazily, register_previews

if TYPE_CHECKING:
    from geoscene.export import export_scene as export_scene
    from geoscene.options import BuildOptions as BuildOptions
    from geoscene.options import ExportOptions as ExportOptions
    from geoscene.options import ViewOptions as ViewOptions
    from geoscene.pipeline.build import build as build
    from geoscene.scene import Scene as Scene
    from geoscene.scene import open_scene as open_scene
    from geoscene.sources import demo_path as demo_path
    from geoscene.sources import read_osm as read_osm
    from geoscene.support.progress import show_progress as show_progress
    from geoscene.support.progress import silent as silent
    from geoscene.view import view_scene as view_scene

__version__ = "0.1.0"

_HOMES = {
    "BuildOptions": "options",
    "ExportOptions": "options",
    "Scene": "scene",
    "ViewOptions": "options",
    "build": "pipeline.build",
    "demo_path": "sources",
    "export_scene": "export",
    "open_scene": "scene",
    "read_osm": "sources",
    "show_progress": "support.progress",
    "silent": "support.progress",
    "view_scene": "view",
}
__all__ = list(_HOMES)


__getattr__ = lazily(__name__, _HOMES)

register_previews({"geoscene.scene.layout.Scene": "geoscene.scene.preview"})
