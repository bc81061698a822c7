"""Pairs of least total cost, beside scipy's."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from kinefit.errors import ObservationError
from kinefit.fitting.multiview.association import assign


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (4, 4), (3, 7), (8, 2), (12, 12)])
@pytest.mark.parametrize("seed", range(4))
def test_the_total_is_the_least(shape, seed):
    cost = np.random.default_rng(seed).normal(size=shape)
    rows, columns = linear_sum_assignment(cost)
    pairs = assign(cost)
    assert len(pairs) == min(shape) == len({c for _, c in pairs}) == len({r for r, _ in pairs})
    np.testing.assert_allclose(sum(cost[p] for p in pairs), cost[rows, columns].sum(), atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_who_costs_too_much_stays_alone(seed):
    cost, most = np.random.default_rng(seed).uniform(size=(5, 6)), 0.35
    pairs = assign(cost, most)
    assert all(cost[p] < most for p in pairs)
    rows, columns = linear_sum_assignment(np.minimum(cost - most, 0.0))
    np.testing.assert_allclose(
        sum(cost[p] - most for p in pairs), np.minimum(cost - most, 0.0)[rows, columns].sum(), atol=1e-12
    )


def test_what_is_impossible_is_no_pair():
    assert assign([[np.inf, 1.0], [np.inf, 2.0]]) == [(0, 1)]
    assert assign([[0.5], [0.4], [np.inf]], 0.45) == [(1, 0)] and assign([[0.5, 0.6]], 0.45) == []
    assert assign(np.full((2, 2), np.inf)) == [] and assign(np.zeros((0, 3))) == []
    assert sorted(assign([[np.inf, 1.0], [2.0, 100.0]])) == [(0, 1), (1, 0)]


def test_no_matrix_is_told():
    for wrong in ([1.0, 2.0], [[np.nan]]):
        with pytest.raises(ObservationError):
            assign(wrong)
