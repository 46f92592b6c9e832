"""From a route to the trajectory of the ego vehicle."""
