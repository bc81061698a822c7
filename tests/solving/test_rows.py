"""Rows, the narrow waist: how they are made, joined and sorted out."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.solving.rows import DofRows, PairRows, ParameterRows, Rows, less_sure, sort_out, weaker


def some_rows(count, seed=0, group=None):
    random = np.random.default_rng(seed)
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Rows.of(
        random.integers(0, 4, count), random.normal(size=(count, 3)), direction, random.normal(size=count),
        random.uniform(1, 9, count), group,
    )  # fmt: skip


def some_pairs(**changes):
    given = {
        "segments": np.array([[0, 1]]), "point_a": np.zeros((1, 3)), "point_b": np.ones((1, 3)),
        "direction": np.array([[1.0, 0, 0]]), "residual": np.ones(1), "weight": np.ones(1),
    }  # fmt: skip
    return PairRows(**(given | changes))


def test_rows_give_back_what_they_were_made_of():
    segment, group = [2, 0], [7, 7]
    point, direction = [[1, 2, 3], [4, 5, 6]], [[0, 0, 1], [1, 0, 0]]
    rows = Rows.of(segment, point, direction, [0.1, 0.2], 25.0, group)
    assert len(rows) == 2 and rows.data.shape == (8, 2) and rows.data.flags.c_contiguous
    np.testing.assert_array_equal(rows.point, point)
    np.testing.assert_array_equal(rows.direction, direction)
    np.testing.assert_array_equal(rows.residual, [0.1, 0.2])
    np.testing.assert_array_equal(rows.weight, [25.0, 25.0])
    assert list(rows.segment) == segment and list(rows.group) == group


def test_every_row_is_its_own_measurement_by_default():
    assert list(some_rows(5).group) == [0, 1, 2, 3, 4]


def test_joined_rows_keep_their_measurements_apart():
    a, b, c = some_rows(3, 1, [0, 0, 4]), some_rows(2, 2, [-1, 0]), some_rows(4, 3, [1, 1, 0, 0])
    joined = Rows.concat(a, b, c)
    assert len(joined) == 9
    np.testing.assert_array_equal(joined.data, np.concatenate([a.data, b.data, c.data], axis=1))
    np.testing.assert_array_equal(joined.segment, np.concatenate([a.segment, b.segment, c.segment]))
    parts = [joined.group[:3], joined.group[3:5], joined.group[5:]]
    for old, new in zip((a, b, c), parts, strict=True):  # the same rows belong together as before
        np.testing.assert_array_equal(old.group[:, None] == old.group, new[:, None] == new)
    assert parts[1][0] == -1
    ids = [set(p[p >= 0].tolist()) for p in parts]
    assert not ids[0] & ids[1] and not ids[1] & ids[2] and not ids[0] & ids[2]


def test_joining_nothing():
    assert len(Rows.concat()) == 0
    empty = Rows.concat(some_rows(0), some_rows(2), some_rows(0))
    assert len(empty) == 2 and empty.data.flags.c_contiguous


def test_rows_are_sorted_out_by_kind():
    rows, pairs, parameters = some_rows(2), some_pairs(), ParameterRows(np.array([6]), np.ones(1), np.ones(1))
    dense = DofRows(np.ones((2, 9)), np.ones(2), np.ones(2), np.arange(2))
    for given in ([rows, pairs, dense, parameters, rows], iter([pairs, rows, rows, parameters, dense])):
        r, p, q, d = sort_out(given)
        assert len(r) == 4 and p == [pairs] and q == [parameters] and d == [dense]
    assert sort_out(rows)[0] is rows and sort_out([rows])[0] is rows
    assert sort_out(pairs)[1] == [pairs] and len(sort_out(pairs)[0]) == 0
    assert sort_out(parameters)[2] == [parameters]


def test_rows_on_degrees_of_freedom_must_fit_together():
    with pytest.raises(ObservationError, match=r"jacobian of DofRows has shape \(3, 9\).*Give \(2, 9\)"):
        DofRows(np.ones((3, 9)), np.ones(2), np.ones(2), np.arange(2))
    with pytest.raises(ObservationError, match="not finite"):
        DofRows(np.full((2, 9), np.nan), np.ones(2), np.ones(2), np.arange(2))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rows_must_be_finite(bad):
    for column in range(4):
        values = [np.zeros((2, 3)), np.tile([1.0, 0, 0], (2, 1)), np.zeros(2), np.ones(2)]
        values[column][1] = bad
        with pytest.raises(ObservationError, match=r"not finite.*Leave out"):
            Rows.of([0, 0], *values)
    with pytest.raises(ObservationError, match="pair rows"):
        some_pairs(residual=np.array([bad]))
    with pytest.raises(ObservationError, match="pair rows"):
        some_pairs(point_b=np.full((1, 3), bad))
    with pytest.raises(ObservationError, match="parameter rows"):
        ParameterRows(np.array([0]), np.array([bad]), np.ones(1))


def test_rows_of_any_kind_take_lists():
    pairs = PairRows([[0, 1]], [[0, 0, 0]], [[0, 0, 1]], [[0, 0, 1]], [1], [2])
    parameters = ParameterRows([6], [1], [2])
    for record, name in ((pairs, "segments"), (parameters, "index")):
        assert getattr(record, name).dtype == np.int64 and getattr(record, name).flags.c_contiguous
    assert pairs.point_b.shape == (1, 3) and pairs.residual.dtype == parameters.weight.dtype == float


def test_rows_of_unequal_length_are_refused():
    with pytest.raises(ObservationError, match=r"weight of ParameterRows has shape \(1,\).*Give \(2,\)"):
        ParameterRows([6, 7], [1.0, 2.0], [1.0])
    with pytest.raises(ObservationError, match=r"point_b of PairRows has shape \(2, 3\).*Give \(1, 3\)"):
        some_pairs(point_b=np.ones((2, 3)))


def kinds_of_rows():
    one = np.ones(3)
    full = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
    index = np.arange(3)
    return [
        some_rows(3), ParameterRows(index, one, 2.0 * one), ParameterRows(index, one, full),
        DofRows(np.ones((3, 9)), one, 5.0 * one, index),
    ]  # fmt: skip


@pytest.mark.parametrize("rows", kinds_of_rows())
def test_variances_are_added_to_rows_of_every_kind(rows):
    more = np.array([0.0, 0.25, 3.0])
    weight, wider = (w if w.ndim == 2 else np.diag(w) for w in (rows.weight, less_sure(rows, more).weight))
    np.testing.assert_allclose(np.linalg.inv(wider), np.linalg.inv(weight) + np.diag(more), rtol=1e-12)
    np.testing.assert_allclose(weaker(rows, 3.0).weight, rows.weight / 9.0)
    np.testing.assert_array_equal(weaker(rows, 3.0).residual, rows.residual)


def test_a_row_that_is_not_felt_stays_so():
    assert less_sure(some_rows(1).__class__.of([0], [[0, 0, 0]], [[1, 0, 0]], [1], 0.0), np.ones(1)).weight == 0.0
