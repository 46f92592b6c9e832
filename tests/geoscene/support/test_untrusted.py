"""Archives of arrays and TOML that lie about their size or nest without end."""

import bz2
import gzip
import io
import tomllib
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from geoscene.scene.tile_files import pack
from geoscene.support.untrusted import (
    DAMAGED_ARCHIVE,
    VARIABLE,
    TooLargeError,
    open_unpacked,
    read_arrays,
    read_toml,
)

KINDS = st.sampled_from(["f4", "f8", "i4", "u1", "i8", "?", "U3"])


def packed(**columns):
    out = io.BytesIO()
    np.savez_compressed(out, **columns)
    return out


@pytest.mark.full
@given(arrays.arrays(KINDS, arrays.array_shapes(min_dims=0, max_dims=3, min_side=0)), st.booleans())
def test_arrays_are_those_that_numpy_wrote(array, by_columns):
    stored = np.asfortranarray(array) if by_columns else array
    found = read_arrays(packed(a=stored, b=np.arange(3)))
    assert found.keys() == {"a", "b"}
    assert found["a"].dtype == array.dtype
    np.testing.assert_array_equal(found["a"], array)
    assert found["a"].flags.writeable


@pytest.mark.parametrize("count", ["1000000000000", "99999999999999999999", "11", "9", "-1"])
def test_an_array_must_be_as_long_as_its_header_states(count):
    member = io.BytesIO()
    np.save(member, np.zeros(10))
    data = member.getvalue().replace(b"(10,)", f"({count},)".encode())
    data = data.replace(b" \n", b"\n", 1)[: len(data)]
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.npy", data)
    tracemalloc.start()
    with pytest.raises(DAMAGED_ARCHIVE):
        read_arrays(out)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_objects_are_not_read():
    out = io.BytesIO()
    np.savez(out, a=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="objects"):
        read_arrays(out)


@given(st.binary(max_size=400))
def test_bytes_that_are_no_archive_are_refused(data):
    with pytest.raises(DAMAGED_ARCHIVE):
        read_arrays(io.BytesIO(data))


@pytest.mark.parametrize("value", ["[" * 5000, "{a=" * 5000, "9" * 5000, "[1"])
def test_toml_without_an_end_is_an_error_of_toml(value):
    with pytest.raises(tomllib.TOMLDecodeError):
        read_toml(f"a = {value}")


@given(arrays.arrays(KINDS, arrays.array_shapes(min_dims=1, max_dims=3, min_side=0)), st.booleans())
def test_columns_of_tiles_are_files_as_numpy_writes_them(array, by_columns):
    plain = io.BytesIO()
    np.save(plain, np.ascontiguousarray(array))
    with zipfile.ZipFile(
        io.BytesIO(pack({"a": np.asfortranarray(array) if by_columns else array}))
    ) as archive:
        assert archive.read("a.npy") == plain.getvalue()


@pytest.mark.parametrize(("pack_bytes", "packing"), [(gzip.compress, ".gz"), (bz2.compress, ".bz2")])
def test_a_file_is_unpacked_to_a_limit(tmp_path, monkeypatch, pack_bytes, packing):
    path, size = tmp_path / "a", 2**26 + 10
    path.write_bytes(pack_bytes(b" " * size))

    def length():
        with open_unpacked(path, packing) as file:
            return sum(map(len, iter(lambda: file.read(2**20), b"")))

    with pytest.raises(TooLargeError, match=f"unpacked to more than 64 MiB .* set {VARIABLE}"):
        length()
    monkeypatch.setenv(VARIABLE, "inf")
    assert length() == size


def test_an_archive_is_unpacked_to_a_limit(monkeypatch):
    archive = packed(a=np.zeros(2**26 + 10, np.uint8))
    with pytest.raises(TooLargeError, match=VARIABLE):
        read_arrays(archive)
    monkeypatch.setenv(VARIABLE, "5000")
    assert len(read_arrays(archive)["a"]) == 2**26 + 10
    monkeypatch.setenv(VARIABLE, "many")
    with pytest.raises(TooLargeError, match="GEOSCENE_UNPACK_RATIO=many: give a ratio"):
        read_arrays(archive)
