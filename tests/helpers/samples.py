"""Small samples for drives to an accuracy and spot checks, which then take a second."""

from lidar.tools.tradeoff import sample, search


def measure_little(patch):
    """Let searches and spot checks take few frames, pulses and pixels."""
    patch.setattr(search, "SAMPLES", (3, 6))
    patch.setattr(sample, "MOST_RAYS", 127)
    patch.setattr(sample, "_SCREENED", 800)
    patch.setattr(sample, "_HARD", 40)
    patch.setattr(sample, "_EASY", 40)
    patch.setattr(sample, "_BLOCKS", 16)
