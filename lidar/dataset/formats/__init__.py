"""Point-cloud formats."""
