"""Cables hang between mapped poles, contact wires over tracks; none of them without relief."""

import numpy as np
import pytest

from geoscene.classes import Class
from geoscene.export.objects import expand
from geoscene.geometry.frames import Frame
from geoscene.objects.shapes import shapes
from geoscene.objects.wires import read_wires, wire_instances
from geoscene.options import BuildOptions
from geoscene.pipeline.plan import make_plan
from geoscene.sources import read_osm
from geoscene.sources.data import OsmData, TaggedNode, Way
from geoscene.support.progress import silent

FRAME = Frame.at(11.0, 50.0)
EXTENT = (-200.0, -200.0, 200.0, 200.0)
LIBRARY = list(shapes(with_relief=True).values())


def line_of(tags, *xy, poles=True):
    lonlat = np.column_stack(FRAME.to_geographic(*np.array(xy, float).T))
    nodes = np.arange(1, len(xy) + 1)
    points = [
        TaggedNode(f"node/{n}", {"power": "pole"}, *at) for n, at in zip(nodes, lonlat, strict=True) if poles
    ]
    return OsmData((10.9, 49.9, 11.1, 50.1), [Way("way/3", tags, nodes, lonlat)], [], points, [])


def wires_of(tags, *xy, poles=True):
    return read_wires(line_of(tags, *xy, poles=poles), FRAME, extent=EXTENT)


def test_three_cables_hang_from_pole_to_pole_and_sag_between():
    wires = wires_of({"power": "minor_line"}, (-40, 0), (0, 0), (40, 0))
    assert len(wires) == 6
    mesh = expand(wire_instances(wires, height=lambda x, y: 100.0 + 0 * x * y), LIBRARY)
    assert set(mesh.klass) == {Class.WIRE}
    x, y, z = mesh.vertices.T
    assert z.max() == pytest.approx(108.75, abs=0.02)
    low = z[np.abs(np.abs(x) - 20) < 0.1].min()
    assert low == pytest.approx(108.6 - 0.015 * 40, abs=0.02)
    assert np.abs(y).max() == pytest.approx(0.35, abs=0.02)
    assert np.ptp(x) == pytest.approx(80.0, abs=0.02)
    assert len(np.unique(wires.feature)) == 6


def test_pieces_of_a_wire_reach_into_each_other_and_have_its_width():
    copies = wire_instances(wires_of({"power": "minor_line"}, (0, 0), (30, 40)))
    ends = copies.transform[:, :, 3] + copies.transform[:, :, 0]
    own = np.arange(len(copies)).reshape(3, 8)
    into = ends[own[:, :-1]] - copies.transform[own[:, 1:], :, 3]
    np.testing.assert_allclose(np.linalg.norm(into, axis=2), 0.01, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(copies.transform[:, :, 1:3], axis=1), 0.025)
    assert (np.linalg.det(copies.transform[:, :, :3]) > 0).all()


@pytest.mark.parametrize(
    "tags",
    [
        {"power": "minor_line", "location": "underground"},
        {"railway": "tram", "tunnel": "yes"},
        {"railway": "tram", "electrified": "no"},
        {"railway": "rail"},
        {"highway": "residential"},
    ],
)
def test_other_lines_have_no_wires(tags):
    assert len(wires_of(tags, (-40, 0), (0, 0))) == 0


def test_a_line_without_mapped_poles_has_no_cables():
    assert len(wires_of({"power": "minor_line"}, (-40, 0), (0, 0), poles=False)) == 0


def test_spans_longer_than_any_of_its_kind_are_left_out():
    assert len(wires_of({"power": "minor_line"}, (-180, 0), (0, 0))) == 0


def test_the_contact_wire_of_a_tramway_follows_the_track():
    wires = wires_of({"railway": "tram"}, (-100, 0), (0, 0), (0, 60), poles=False)
    points = expand(wire_instances(wires), LIBRARY).vertices
    assert points[:, 2].max() == pytest.approx(5.5, abs=0.01)
    assert points[:, 2].min() > 5.5 - 0.12
    on_track = np.minimum(np.abs(points[:, 1]) + (points[:, 0] > 0.1), np.abs(points[:, 0]))
    assert on_track.max() < 0.02


@pytest.mark.shared
def test_tramways_of_a_real_place_have_wires_with_relief_alone(shared_osm):
    osm = read_osm(shared_osm("helsinki_center.osm.pbf"), bounds=(24.940, 60.168, 24.946, 60.171))
    plan, _ = make_plan(osm, BuildOptions(relief="plain"), progress=silent)
    assert (plan.wires.kind == "contact").sum() > 20
    assert "wires" in {layer.name for layer in plan.layers}
    assert plan.ranges["wires"] == (plan.wires.feature[0], plan.wires.feature[-1] + 1)
    assert sum(len(rows) for rows in plan.rows["wires"].values()) == len(plan.wires)
    off, _ = make_plan(osm, BuildOptions(relief="off"), progress=silent)
    assert len(off.wires) == 0
    assert "wires" not in off.ranges
