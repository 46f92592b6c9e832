"""Placement of street furniture with relief on sidewalks: shelters, bicycle stands, inferred objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geoscene.objects.furniture import Furniture, usual_height
from geoscene.objects.siting import Sites
from geoscene.objects.street import FurnitureGuesses, Taken, site_guesses, usable
from geoscene.support.splitmix import number_of, uniform_at

_SHELTER_BACK = 0.8
"""Metres from the place of a bus stop, beside the kerb, to the middle of its shelter."""


def with_guesses(
    table: Furniture, guesses: FurnitureGuesses, *, sites: Sites, taken: Taken, first: int
) -> Furniture:
    """The table, and the guesses that find a place, with numbers from ``first`` on."""
    row, xy, heading = site_guesses(guesses, sites, taken=taken)
    n, found = len(row), guesses.take(row)
    added = Furniture(
        xy,
        found.shape,
        np.array([usual_height(str(shape)) for shape in found.shape], float),
        heading,
        np.full(n, "default"),
        np.full(n, "guess"),
        np.zeros(n),
        np.full(n, "road"),
        found.source,
        np.full(n, ""),
        found.osm_id,
        (first + row).astype(np.int32),
    )
    return Furniture.concatenate([table, with_details(added, sites, full=True)])


def with_details(table: Furniture, sites: Sites, *, full: bool) -> Furniture:
    """The table with bus shelters moved back from the road, and bicycle stands where space allows.

    full : bicycles lean on two thirds of the stands, drawn by the id and the number of each
    """
    stand, shelter = table.shape == "bicycle_stand", table.shape == "bus_shelter"
    toward = np.column_stack([np.cos(table.heading), np.sin(table.heading)])
    back = table.xy - _SHELTER_BACK * toward
    fits = usable(sites, back) & usable(sites, table.xy - 2 * _SHELTER_BACK * toward)
    shape = np.where(shelter & ~fits, "bus_stop", table.shape).astype("U24")
    if full:
        number = np.array([number_of(str(name)) for name in table.osm_id], np.int64)
        parked = np.floor(3 * uniform_at(number, table.feature.astype(np.int64), count=1)[0]).astype(np.int64)
        shape = np.where(stand & (parked > 0), np.char.mod("bicycle_stand_%d", parked), shape)
    usual = np.array([usual_height(str(name)) for name in shape], float)
    moved = replace(
        table,
        xy=np.where((shelter & fits)[:, None], back, table.xy),
        shape=shape,
        height=np.where(shape == table.shape, table.height, usual),
    )
    return moved.take(~stand | usable(sites, table.xy))
