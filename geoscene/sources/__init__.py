"""Where maps come from: files, map servers, and the demo extract."""

from geoscene.sources.data import ATTRIBUTION as ATTRIBUTION
from geoscene.sources.data import Area as Area
from geoscene.sources.data import OsmData as OsmData
from geoscene.sources.data import Point as Point
from geoscene.sources.data import Relation as Relation
from geoscene.sources.data import Tags as Tags
from geoscene.sources.data import Way as Way
from geoscene.sources.files import read_osm as read_osm
