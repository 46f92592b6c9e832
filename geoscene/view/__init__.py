"""A scene as one web page that needs neither network nor server."""

from geoscene.view.page import view_scene as view_scene
