"""Weather between a sensor and what it sees: media, echoes, published models, weather over time and place."""
