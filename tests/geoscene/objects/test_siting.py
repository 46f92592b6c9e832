"""No post, pole or trunk stands on a carriageway."""

import numpy as np
import pytest
import shapely

from geoscene.classes import Class
from geoscene.ground.partition import rows_at, values_at
from geoscene.objects.siting import FARTHEST
from geoscene.options import BuildOptions
from geoscene.pipeline.plan import make_plan
from geoscene.sources import demo_path, read_osm
from geoscene.support.progress import silent

EXTRACTS = [
    "nyc_lower_east_side.osm.pbf",
    "helsinki_center.osm.pbf",
    "berlin_neukoelln.osm.gz",
    "monaco.osm.pbf",
    "norfolk_odu_roads.osm.gz",
]


def assert_off_carriageways(path):
    plan, problems = make_plan(read_osm(path), BuildOptions(relief="off"), progress=silent)
    layers = plan.ground.layers
    rails = shapely.union_all(layers.polygon[layers.klass == Class.RAIL])
    for table in (plan.furniture, plan.trees):
        klass = values_at(layers.klass, rows_at(plan.ground, table.xy), base=plan.ground.base[0])
        driven = np.isin(klass, [Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.RAIL, Class.TUNNEL])
        assert table.osm_id[driven].tolist() == []
        assert table.osm_id[klass == Class.BUILDING_PAD].tolist() == []
        assert table.osm_id[shapely.dwithin(shapely.points(table.xy), rails, 0.7)].tolist() == []
        still = table.moved == 0
        assert np.isin(table.place_source[~still], ["moved", "roadside"]).all()
        assert (table.place_source[still] != "moved").all()
        assert (table.moved <= 2 * FARTHEST).all()
    return plan, problems


@pytest.mark.full
def test_no_object_of_the_demo_stands_on_a_carriageway():
    plan, _ = assert_off_carriageways(demo_path())
    assert (plan.furniture.place_source == "moved").sum() > 100
    assert np.median(plan.furniture.moved[plan.furniture.place_source == "moved"]) < 3.0


@pytest.mark.shared
@pytest.mark.parametrize("name", EXTRACTS)
def test_no_object_of_a_real_place_stands_on_a_carriageway(shared_osm, name):
    assert_off_carriageways(shared_osm(name))
