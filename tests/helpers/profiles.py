"""Small samples for stored profiles and spot checks, which then take a second."""

from lidar.tools.tradeoff import profile, profile_costs, profile_errors, sampling


def measure_little(patch, *, folder=None):
    """Let profiles and spot checks take few frames and pulses; profiles are kept in a folder, if given."""
    patch.setattr(profile, "_DRIVES", 4)
    patch.setattr(profile, "_SECONDS", 1.0)
    patch.setattr(profile, "_FRAMES", 1)
    patch.setattr(profile_costs, "_BLOCK_PULSES", 500)
    patch.setattr(profile_errors, "_BLOCKS", 16)
    patch.setattr(sampling, "REFERENCE_RAYS", 127)
    patch.setattr(sampling, "_SCREENED", 800)
    patch.setattr(sampling, "_COMPARED", 40)
    if folder is not None:
        patch.setattr(profile, "default_folder", lambda: folder)
