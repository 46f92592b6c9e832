"""Functions translated for Warp compute what numba computes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.support.compiled import njit
from lidar.sensors.camera import ground_texture, texture

wp = pytest.importorskip("warp", reason="the extra gpu is not installed")

SIZES = np.array([[0.5, 2.0], [3.0, 7.0], [0.25, 1.0]])
KEY = np.uint32(0x9E3779B1)
PAIR = (0.75, 1.5)


@njit()
def swapped(a, b):
    return b, a, a < b


@njit()
def first_of(both):
    return both[0]


@njit()
def looped(n, x):
    total = count = 0.0
    for k in range(n):
        if k == 2:
            continue
        total += x / (k + 1)
        count += 1
    return total + 0.5 * count


@njit()
def set_all(out, value):
    out[:] = 0.25
    out[1] = value
    out[2] *= 4


@njit()
def everything(i, x, y, out):
    """Expressions in which numba and Warp differ: types that meet, quotients, remainders, tuples."""
    a, b = x, y
    a, b = b, a
    low, high, less = swapped(a, b)
    out[0] = a + 2 * b - i
    out[1] = i / 4 + 1 / 2
    out[2] = math.floor(x) % 3 + (i - 5) % 2
    out[3] = max(low, 0, min(high, 10, x + y))
    out[4] = 1.0 if -1.0 < x <= 1 < y else 2.0
    p, q = (x, y) if less else (-1.0, -2.0)
    out[5] = p + 10 * q + PAIR[1] * PAIR[0]
    size, other = SIZES[i % 3]
    out[6] = size * other**2 + SIZES[i % 3, 1]
    out[7] = float(np.uint32(np.uint32(i - 5) * KEY + np.uint32(0x85EBCA77)) >> np.uint32(8))
    out[8] = first_of(swapped(x, y)) + first_of((x, y))
    out[9] = looped(i, x)
    out[10] = int(x) if x > 0 and 1 / x > 0.1 else 0
    out[11] = texture.noise(x, y, 3) + math.pi * texture.hash_place(math.floor(x), i, 1)
    out[12] = texture.detail(i % 8, i % 2, x, y, x - y, y, 0.02)
    out[13] = ground_texture.ground(i % 7, i > 3, x, y, 0.6, 0.8, 0.01, 0.08)


@njit()
def everywhere(x, out):
    rest = np.empty(3)
    for i in range(len(x)):
        everything(i, x[i, 0], x[i, 1], out[i])
        set_all(rest, x[i, 0])
        out[i, 14] = rest[0] + rest[1] + rest[2]


@pytest.fixture(scope="module")
def on_device(tmp_path_factory):
    """Runs the same kernel on Warp's CPU device."""
    from lidar.raycast.device import device  # noqa: PLC0415
    from lidar.raycast.translate import Translation  # noqa: PLC0415

    wp.config.kernel_cache_dir = str(tmp_path_factory.getbasetemp() / "warp")
    there = device("warp-cpu")
    translation = Translation("test_translate")
    one, fill = translation.of(everything), translation.of(set_all)
    struct = translation.struct()

    @wp.kernel
    def kernel(x: wp.array2d[wp.float64], out: wp.array2d[wp.float64], tables: struct):
        i = wp.tid()
        one(i, x[i, 0], x[i, 1], out[i], tables)
        rest = wp.zeros(shape=(3,), dtype=wp.float64)
        fill(rest, x[i, 0], tables)
        out[i, 14] = rest[0] + rest[1] + rest[2]

    tables = struct()
    for name, array in translation.arrays.items():
        setattr(tables, name, there.upload(array))

    def run(x):
        out = there.upload(np.zeros((len(x), 15)))
        wp.launch(kernel, dim=len(x), inputs=[there.upload(x), out, tables], device=there.warp_device)
        return out.numpy()

    return run


REALS = st.floats(-1e4, 1e4) | st.integers(-20, 20).map(float) | st.sampled_from([0.0, -0.0, 1e-300, 0.5])


@settings(max_examples=60, deadline=None)
@given(x=st.lists(st.tuples(REALS, REALS), min_size=1, max_size=12).map(np.array))
def test_the_same_source_gives_the_same_numbers(x, on_device):
    expected = np.zeros((len(x), 15))
    everywhere(x, expected)
    np.testing.assert_allclose(on_device(x), expected, rtol=1e-6, atol=1e-6)
