"""From a map to a scene: the plan of the whole place, then one tile at a time."""
