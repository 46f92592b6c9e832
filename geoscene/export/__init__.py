"""Scenes in the formats of other programs."""

from geoscene.export.kinds import KINDS as KINDS
from geoscene.export.kinds import ExportFormat as ExportFormat
from geoscene.export.kinds import Summary as Summary
from geoscene.export.kinds import export_scene as export_scene
from geoscene.export.kinds import kind_of as kind_of
