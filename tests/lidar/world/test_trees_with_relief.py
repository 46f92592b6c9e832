"""Trees with relief in the world of rays."""

import numpy as np

from geoscene.classes import Class
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources.data import OsmData, TaggedNode, Way
from lidar.world.world import World


def test_leaves_let_rays_pass_and_limbs_do_not(tmp_path):
    """A crown holds leaf clusters and limbs; only the faces of clusters have leaves behind them."""
    road = Way("way/1", {"highway": "residential"}, np.arange(2), np.array([[11.0, 50.0], [11.001, 50.0]]))
    tree = TaggedNode("node/9", {"natural": "tree"}, 11.0005, 50.0002)
    osm = OsmData((11.0, 49.9995, 11.001, 50.0005), [road], [], [tree], [])
    scene = build(osm, tmp_path / "scene", options=BuildOptions(relief="plain"))
    world = World.load(scene)
    faces = world.faces
    klass, leaves = (faces.packed >> 8) & 255, faces.leaves[(faces.packed >> 16) & 255]
    assert (leaves[klass == Class.TREE_CROWN] > 1.0).sum() > 1000
    assert (leaves[klass == Class.TREE_CROWN] > 0).all()
    assert (leaves[klass == Class.TRUNK] == 0).all()
