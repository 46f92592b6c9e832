"""``python -m geoscene``."""

from geoscene.cli import main

main()
