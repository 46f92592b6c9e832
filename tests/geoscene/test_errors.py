"""Reasons of errors in plain words, without those of Python."""

import csv
import json
import re
import struct
import zlib
from io import StringIO

import numpy as np
import pytest

from geoscene.errors import InputError, reading, reason_of

PYTHON = re.compile(
    r"Error|Errno|NoneType|object|literal|codec|unpack|index|range|Expecting|argument|attribute|convert"
)


def failures():
    """Texts of code that fails as readers of damaged files do."""
    return {
        "int('abc')": "'abc' is not a whole number",
        "float('abc')": "'abc' is not a number",
        "np.loadtxt(StringIO('1 2\\n3 x'))": "'x' in row 1, column 2 is not a number",
        "np.loadtxt(StringIO('1 2\\n3'))": "row 2 has 1 columns, the first 2",
        "b'\\xff'.decode()": "no UTF-8 text at byte 1",
        "json.loads('{')": "it ends too early",
        "json.loads('[1, 2')": "it ends too early",
        "json.loads('{a: 1}')": "no JSON at line 1, column 2",
        "{}['kind']": "'kind' is missing",
        "[][3]": "it ends too early or is damaged",
        "None.get('a')": "contents of another form than expected",
        "None['a']": "contents of another form than expected",
        "len(5)": "contents of another form than expected",
        "[1] < 'a'": "contents of another form than expected",
        "struct.unpack('<I', b'1')": "it ends too early or is damaged",
        "zlib.decompress(b'12345')": "it ends too early or is damaged",
        "int(float('nan'))": "a number that is not finite",
        "np.zeros(5).reshape(2, 3)": "a number of values that does not fit the stated one",
        "(lambda a, b: 0)(1)": "contents of another form than expected",
        "__import__('datetime').datetime.fromisoformat('noon')": "'noon' is not an ISO 8601 time",
        "bytes.fromhex('xy')": "digits that are not hexadecimal",
        "list(csv.reader(['\"a']  , strict=True))": "unexpected end of data",
    }  # fmt: skip


@pytest.mark.parametrize(("code", "plain"), failures().items())
def test_reasons_are_in_plain_words(code, plain):
    names = {"np": np, "json": json, "struct": struct, "zlib": zlib, "StringIO": StringIO, "csv": csv}
    with pytest.raises(Exception) as caught:  # noqa: PT011 - each its own
        eval(code, names)  # noqa: S307
    assert reason_of(caught.value) == plain
    with pytest.raises(InputError) as raised, reading("a.csv", InputError, remedy="drive again"):
        raise caught.value
    assert str(raised.value) == f"a.csv: damaged ({plain}); drive again"
    assert not PYTHON.search(str(raised.value))


def test_values_of_the_wrong_number_are_counted():
    with pytest.raises(ValueError, match="unpack") as caught:
        a, b, c = (1, 2)  # noqa: F841
    assert reason_of(caught.value) == "2 values where 3 are needed"
    with pytest.raises(ValueError, match="unpack") as caught:
        a, b = (1, 2, 3)  # noqa: F841
    assert reason_of(caught.value) == "more values than the 2 that are needed"
    assert reason_of(InputError("two\nlines")) == "two lines"
