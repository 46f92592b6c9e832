"""Physics of laser returns: reflectance, received power, echoes, detection, noise and intensity codes."""
