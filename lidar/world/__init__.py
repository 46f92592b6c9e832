"""The world that rays intersect: the static scene and the road users in it."""
