"""Options of the commands of `lidar`: defaults, units, help and the recipe of a dataset, declared once."""
