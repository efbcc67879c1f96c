"""Columns of Arrow tables: the values that Arrow itself gives, and no pandas."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from hdmap_tools.readers.arrow import values_of

NUMBERS = [0, 1, 5, 127, 3]


@pytest.mark.parametrize(
    "kind", ["int8", "uint8", "int16", "int32", "int64", "uint64", "float16", "float32", "float64"]
)
@pytest.mark.parametrize("chunks", [1, 3])
def test_numbers_are_those_of_arrow(kind, chunks):
    arrays = [pa.array(np.array(NUMBERS, dtype=kind)) for _ in range(chunks)]
    column = pa.chunked_array([*arrays, arrays[0][:0], arrays[0][2:4]])
    found = values_of(column)
    assert found.dtype == np.dtype(kind)
    np.testing.assert_array_equal(found, column.to_numpy())


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 40])
@pytest.mark.parametrize("offset", [0, 3, 8])
def test_truth_values_are_those_of_arrow(count, offset):
    rng = np.random.default_rng(count)
    column = pa.chunked_array([pa.array(rng.random(count + offset) < 0.5)[offset:]])
    found = values_of(column)
    assert found.dtype == bool
    np.testing.assert_array_equal(found, column.to_numpy())


def test_missing_values_are_nan_and_names_stay_names():
    found = values_of(pa.chunked_array([pa.array([1, None, 3])]))
    np.testing.assert_array_equal(found, [1.0, np.nan, 3.0])
    assert values_of(pa.chunked_array([pa.array(["a", "b"])])).tolist() == ["a", "b"]
    assert len(values_of(pa.chunked_array([], type=pa.int32()))) == 0


def test_pandas_is_not_imported():
    program = """
import sys
import pyarrow as pa
from hdmap_tools.readers.arrow import values_of
buffer = pa.py_buffer(bytes(range(8)))
for kind in (pa.uint8(), pa.bool_()):
    column = pa.chunked_array([pa.Array.from_buffers(kind, 8, [None, buffer])])
    assert "pandas" not in sys.modules
    assert len(values_of(column)) == 8
assert "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True)
