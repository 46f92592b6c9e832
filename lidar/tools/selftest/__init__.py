"""The extremes that the program is measured at, as one table for users, tests and the documentation."""
