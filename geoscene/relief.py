"""Relief of surfaces: with how much of it a scene is built, and how much of that is used.

off   : walls are planes and the ground is smooth
plain : windows and doors in depth, kerbs, rough ground, lined tunnels, trees with limbs
full  : guessed small parts, too
scene : what the scene was built with
mesh  : openings of walls as triangles, instead of surfaces that rays meet by formula
"""

from __future__ import annotations

RELIEFS = ("off", "plain", "full")
"""Relief that a scene is built with; each has all of the former."""

MESH = "mesh"

USED_RELIEFS = ("scene", *RELIEFS, MESH)
"""Relief of a scene that a drive uses."""


def sufficient_reliefs(used: str) -> tuple[str, ...]:
    """Reliefs of which a scene must be built with one, for a relief of `USED_RELIEFS` to be used."""
    if used == "full":
        return ("full",)
    return RELIEFS[1:] if used in ("plain", MESH) else RELIEFS
