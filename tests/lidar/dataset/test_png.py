"""Images come back from their files bit for bit."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from lidar.dataset.png import (
    counts_to_depth,
    depth_to_counts,
    encode_png,
    feature_to_image,
    flow_to_image,
    image_to_feature,
    image_to_flow,
    read_png,
    write_png,
)
from lidar.errors import FormatError

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))
IMAGES = st.one_of(
    SIZES.flatmap(lambda s: hnp.arrays(np.uint8, (*s, 3))),
    SIZES.flatmap(lambda s: hnp.arrays(np.uint8, s)),
    SIZES.flatmap(lambda s: hnp.arrays(np.uint16, s)),
)


@settings(max_examples=60, deadline=None)
@given(image=IMAGES)
def test_pillow_reads_the_same_pixels(image, tmp_path_factory):
    path = tmp_path_factory.mktemp("png") / "a.png"
    write_png(path, image)
    with Image.open(path) as opened:
        opened.verify()  # checks every chunk's sum
    with Image.open(path) as opened:
        assert opened.mode == {"uint16": "I;16"}.get(image.dtype.name, "RGB" if image.ndim == 3 else "L")
        np.testing.assert_array_equal(np.array(opened), image)
    back = read_png(path)
    assert back.dtype == image.dtype
    np.testing.assert_array_equal(back, image)


def test_same_pixels_same_bytes():
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    assert encode_png(image) == encode_png(np.asfortranarray(image))


def test_flat_images_are_small():
    assert len(encode_png(np.full((720, 1280), 17, np.uint8))) < 10_000


@pytest.mark.parametrize("bad", [np.zeros((3, 3, 4), np.uint8), np.zeros((3, 3)), np.zeros((0, 3), np.uint8)])
def test_other_arrays_are_refused(bad):
    with pytest.raises(FormatError):
        encode_png(bad)


def test_depth_counts_are_those_of_kitti():
    depth = np.array([0.0, 0.0001, 1.0, 100.0, 255.99, 256.1, np.inf, np.nan], np.float32)
    assert depth_to_counts(depth).tolist() == [1, 1, 256, 25600, 65533, 0, 0, 0]


@settings(max_examples=50, deadline=None)
@given(depth=hnp.arrays(np.float32, 50, elements=st.floats(0.0625, 255.875, width=32)))
def test_depth_round_trips_within_half_a_count(depth):
    back = counts_to_depth(depth_to_counts(depth))
    np.testing.assert_allclose(back, depth, atol=0.5 / 256 + 1e-4)


def test_no_data_comes_back_as_infinity():
    assert np.isinf(counts_to_depth(depth_to_counts(np.array([np.inf])))).all()


@settings(max_examples=30, deadline=None)
@given(feature=hnp.arrays(np.int32, (4, 5), elements=st.integers(-1, 2**24 - 2)))
def test_instances_round_trip(feature):
    image = feature_to_image(feature)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image_to_feature(image), feature)


def test_flow_counts_are_those_of_kitti():
    flow = np.array([[[1.0, -0.5], [np.nan, 0], [600, 0]]], np.float32)
    image = flow_to_image(flow)
    assert image.tolist() == [[[32832, 32736, 1], [0, 0, 0], [0, 0, 0]]]
    back = image_to_flow(image)
    np.testing.assert_array_equal(back[0, 0], [1.0, -0.5])
    assert np.isnan(back[0, 1:]).all()


def test_sixteen_bit_colour_follows_the_png_layout(tmp_path):
    # Pillow reads only half of each number, so the file is taken apart by hand.
    image = np.random.default_rng(0).integers(0, 65535, (7, 5, 3), np.uint16)
    data = encode_png(image)
    at, chunks = 8, {}
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        body = data[at + 4 : at + 8 + length]
        assert struct.unpack_from(">I", data, at + 8 + length)[0] == zlib.crc32(body)
        chunks[body[:4]] = body[4:]
        at += 12 + length
    assert struct.unpack(">IIBBBBB", chunks[b"IHDR"]) == (5, 7, 16, 2, 0, 0, 0)
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(7, 31)
    assert (rows[:, 0] == 2).all()
    whole = np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8)
    np.testing.assert_array_equal(whole.reshape(7, 5, 3, 2).view(">u2")[..., 0], image)
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(FormatError, match="16-bit"):
        read_png(tmp_path / "a.png")


def test_an_unreadable_image_is_named_in_the_error(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"not a png")
    with pytest.raises(FormatError, match=r"a\.png"):
        read_png(path)


@pytest.mark.parametrize("number", [1, 2])
def test_damaged_chunks_of_an_image_are_refused(number, tmp_path):
    path = tmp_path / "a.png"
    write_png(path, np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    whole = path.read_bytes()
    at = [k for k in range(len(whole)) if whole[k : k + 4] in (b"IHDR", b"IDAT", b"IEND")][number - 1]
    path.write_bytes(whole[:at] + b"\xa2\xe7\x85\x96" + whole[at + 4 :])
    with pytest.raises(FormatError, match=r"a\.png"):
        read_png(path)


def test_an_image_of_a_billion_pixels_is_refused(tmp_path):
    path = tmp_path / "a.png"
    write_png(path, np.zeros((1, 1), np.uint8))
    whole = path.read_bytes()
    head = b"IHDR" + (10**5).to_bytes(4) * 2 + whole[24:29]
    path.write_bytes(whole[:12] + head + zlib.crc32(head).to_bytes(4) + whole[33:])
    with pytest.raises(FormatError, match=r"a\.png"):
        read_png(path)
