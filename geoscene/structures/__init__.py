"""Bridges and tunnels: solids, piers, linings, equipment and passages."""

from geoscene.structures.contact import buildings_over as buildings_over
from geoscene.structures.contact import find_openings as find_openings
from geoscene.structures.contact import ground_below as ground_below
from geoscene.structures.contact import opening_layers as opening_layers
from geoscene.structures.passages import Passages as Passages
from geoscene.structures.passages import find_passages as find_passages
from geoscene.structures.passages import mark_passages as mark_passages
from geoscene.structures.passages import passage_cuts as passage_cuts
from geoscene.structures.pieces import within_extent as within_extent
from geoscene.structures.read import read_structures as read_structures
from geoscene.structures.solids import built_structures as built_structures
from geoscene.structures.solids import structure_meshes as structure_meshes
from geoscene.structures.table import StructureOptions as StructureOptions
from geoscene.structures.table import Structures as Structures
