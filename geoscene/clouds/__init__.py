"""Point clouds as a source: the ground, the heights and roofs of buildings, and trees measured in them."""
