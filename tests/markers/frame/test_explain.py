"""Explanations of a frame: what makes one better keeps every point to one label, and costs agree however found."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.papers.markers.synthetic_points import random_pose, synthetic_body

from kinefit.errors import ObservationError
from kinefit.markers.frame.explain import (
    at_level,
    cost_of,
    explain,
    gain_of,
    labels_of,
    polish,
    resolve_conflicts,
    rivals,
    shared_points,
)
from kinefit.markers.frame.identify import identify
from kinefit.markers.frame.search import LabelSearch, UnlabelledFrame
from kinefit.markers.frame.tables import segment_tables


@pytest.fixture(scope="module")
def body():
    return synthetic_body(44)


def seen(body, seed, **kind):
    pose = random_pose(body, np.random.default_rng(seed), **kind)
    at = pose.points
    box = float(np.prod(np.ptp(at, 0) + 0.3))
    gaps = np.linalg.norm(at[:, None] - at, axis=-1)
    return pose, UnlabelledFrame(at, gaps, box, gain_of(0.9 * len(body), len(body), len(at), box), 4.5)


def begun(body, frame, root=0):
    """What a short search makes of a frame: points may be taken twice."""
    search = LabelSearch(segment_tables(body, root), frame, 1.0, 80, 40)
    return search, search.decode(search.node(search.tables[0], None, -1))


@pytest.mark.parametrize("seed", range(6))
def test_every_point_is_taken_once_and_nothing_gets_dearer(body, seed):
    _, frame = seen(body, seed, distortion=0.04, missing=0.2, extra=5)
    search, chosen = begun(body, frame)
    once = resolve_conflicts(search, chosen)
    better = polish(search, once)
    for explanation in (once, better):
        taken = labels_of(explanation, len(body))
        assert not shared_points(search, explanation).any()
        assert len(set(taken[taken >= 0])) == (taken >= 0).sum()
    assert cost_of(search, better) <= cost_of(search, once) + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_rivals_are_other_names_that_cost_little_more(body, seed):
    _, frame = seen(body, seed, distortion=0.06, missing=0.2)
    search, chosen = begun(body, frame)
    best, near, _ = rivals(search, polish(search, resolve_conflicts(search, chosen)))
    for dearer, rival in near:
        assert not shared_points(search, rival).any()
        assert dearer == pytest.approx(cost_of(search, rival) - cost_of(search, best), abs=1e-6)
        assert (labels_of(rival, len(body)) != labels_of(best, len(body))).any()


def test_the_cost_does_not_depend_on_the_segment_begun_with(body):
    _, frame = seen(body, 3, distortion=0.04)
    costs = []
    for root in (0, 1, 5):
        search, chosen = begun(body, frame, root)
        costs.append(cost_of(search, polish(search, resolve_conflicts(search, chosen))))
    assert np.ptp(costs) < 0.5  # places of joints are known a little better from one side than from the other


def test_an_explanation_is_the_same_at_its_own_level_and_keeps_its_names_at_others(body):
    pose, frame = seen(body, 2, distortion=0.04, missing=0.1)
    found = explain(body, frame, 0.02, 4.0)
    assert (found.labels == pose.truth).mean() > 0.95
    again = at_level(found, frame, found.search.scale)
    assert (again.labels == found.labels).all()
    assert again.cost == pytest.approx(found.cost, abs=1e-6)
    assert (at_level(found, frame, 1.5 * found.search.scale).labels == found.labels).mean() > 0.95


def test_what_was_a_moment_ago_decides_what_the_frame_leaves_open(body):
    right = {True: 0, False: 0}
    wrong = {True: 0, False: 0}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        pose = random_pose(body, rng, distortion=0.06, missing=0.15, extra=5)
        before = np.where(pose.truth[:, None] >= 0, pose.points[pose.truth], np.nan)
        before += 0.03 * rng.standard_normal(before.shape)
        for known in (True, False):
            found = identify(body, pose.points, previous=before if known else None).assignment
            right[known] += int(((found == pose.truth) & (found >= 0)).sum())
            wrong[known] += int(((found != pose.truth) & (found >= 0)).sum())
    assert right[True] > right[False]
    assert wrong[True] <= wrong[False]


def test_previous_positions_of_another_shape_are_refused(body):
    pose, _ = seen(body, 0)
    with pytest.raises(ObservationError, match="previous positions"):
        identify(body, pose.points, previous=np.zeros((3, 3)))
