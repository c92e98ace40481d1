"""A table that is stored by output, against the dense array."""

import numpy as np
import pytest

from jaxid.discovery.table import OutputSeries, SignatureTable

RECORDINGS, ROWS, OUTPUTS, COLUMNS = 2, 7, 3, 6


@pytest.fixture
def dense():
    """Columns of one output each, one of two outputs, one of all, and one that is zero."""
    rng = np.random.default_rng(1)
    there = np.array([[1, 0, 0, 1, 1, 0], [0, 1, 0, 1, 1, 0], [0, 0, 1, 0, 1, 0]], bool)
    drawn = rng.standard_normal((RECORDINGS, ROWS, OUTPUTS, COLUMNS))
    return (drawn * there).astype(np.float32)


def test_columns_are_those_of_the_dense_array(dense):
    table = SignatureTable.of(dense)
    assert [c.tolist() for c in table.columns] == [[0, 3, 4], [1, 3, 4], [2, 4]]
    assert table.dense(range(COLUMNS)).dtype == np.float32
    np.testing.assert_array_equal(table.dense(range(COLUMNS)), dense)
    np.testing.assert_array_equal(table.dense([4, 5, 0]), dense[..., [4, 5, 0]])
    assert table.dense([]).shape == (RECORDINGS, ROWS, OUTPUTS, 0)


def test_some_columns_recordings_or_rows(dense):
    table = SignatureTable.of(dense)
    some = table.only([4, 0, 5, 3])
    assert some.width == 4
    np.testing.assert_array_equal(some.dense([3, 0, 1, 2]), dense[..., [3, 4, 0, 5]])
    assert table.only([]).width == 0
    second = table.recordings(slice(1, 2)).dense(range(COLUMNS))
    np.testing.assert_array_equal(second, dense[1:])
    cut = table.rows(np.array([2, 0]), 4).dense(range(COLUMNS))
    np.testing.assert_array_equal(cut, np.stack([dense[0, 2:6], dense[1, :4]]))


def test_series_are_in_any_order(dense):
    first = OutputSeries.of(dense[..., [5, 3, 0]], np.array([5, 3, 0]))
    chosen = np.array([2, 4, 4, 1, 4]), np.array([2, 0, 1, 1, 2])
    columns, output = chosen
    own = OutputSeries(dense[:, :, output, columns], output, columns)
    table = SignatureTable.of_series([first, own], OUTPUTS, COLUMNS)
    assert all(np.all(np.diff(c) > 0) for c in table.columns)
    np.testing.assert_array_equal(table.dense(range(COLUMNS)), dense)


def test_a_column_that_is_not_finite_is_named(dense):
    dense[1, 3, 2, 4] = np.nan
    dense[0, 0, 0, 0] = np.inf
    assert np.flatnonzero(~SignatureTable.of(dense).finite).tolist() == [0, 4]
