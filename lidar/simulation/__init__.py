"""Recording: a drive is planned, its frames are measured one by one, and written as a dataset."""
