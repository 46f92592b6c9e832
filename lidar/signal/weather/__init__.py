"""Weather between a sensor and surfaces: media, echoes, published models, variation in time and place."""
