"""Trees, street furniture, barriers."""
