"""Devices other than the CPU, on which NVIDIA Warp runs kernels (the extra `gpu`)."""
