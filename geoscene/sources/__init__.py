"""Map sources: files, map servers, the demo extract, elevation tiles; `registry` lists them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene.sources.data import AROUND_BOUNDS as AROUND_BOUNDS
from geoscene.sources.data import Area as Area
from geoscene.sources.data import OsmData as OsmData
from geoscene.sources.data import Relation as Relation
from geoscene.sources.data import TaggedNode as TaggedNode
from geoscene.sources.data import Tags as Tags
from geoscene.sources.data import Way as Way
from geoscene.sources.registry import SOURCES as SOURCES
from geoscene.sources.registry import credits_of as credits_of
from geoscene.sources.registry import merge_sources as merge_sources
from geoscene.sources.registry import read_source as read_source
from geoscene.support.registry import lazily

if TYPE_CHECKING:
    from geoscene.sources.elevation import TileServer as TileServer
    from geoscene.sources.elevation import fetch_elevation as fetch_elevation
    from geoscene.sources.elevation import with_elevation as with_elevation
    from geoscene.sources.files import demo_path as demo_path
    from geoscene.sources.files import read_osm as read_osm
    from geoscene.sources.network import Servers as Servers
    from geoscene.sources.network import fetch_bbox as fetch_bbox
    from geoscene.sources.network import fetch_place as fetch_place
    from geoscene.sources.network import fetch_point as fetch_point
    from geoscene.sources.network import locate as locate

_LATE = {
    "demo_path": "files",
    "read_osm": "files",
    "Servers": "network",
    "TileServer": "elevation",
    "fetch_bbox": "network",
    "fetch_elevation": "elevation",
    "fetch_place": "network",
    "fetch_point": "network",
    "locate": "network",
    "with_elevation": "elevation",
}


__getattr__ = lazily(__name__, _LATE)
