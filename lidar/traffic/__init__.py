"""Other road users: simulated, parked, or replayed."""
