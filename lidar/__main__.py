"""``python -m lidar``."""

from lidar.cli import main

main()
