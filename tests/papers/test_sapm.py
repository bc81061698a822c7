"""SAPM as printed (P5): its steps, and the paper's first experiment."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.papers.markers.synthetic_points import random_pose, synthetic_body

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.markers.model.model import MarkerModel
from kinefit.papers._sapm_steps import (
    CandidateTable,
    candidate_table,
    coarse_updates,
    errors,
    mean_distance,
    nearest,
    triples,
)
from kinefit.papers.sapm import SapmProblem, identify_below, sapm, segment_matches


def test_candidates_hold_equation_4_and_come_best_first():
    rng = np.random.default_rng(0)
    x, points = rng.uniform(0, 1, (5, 3)), rng.uniform(0, 1, (30, 3))
    table = candidate_table(x, points, np.ones(30, bool), 2, points[7], 7, 0.1)
    D, d = np.linalg.norm(x - x[2], axis=1), np.linalg.norm(points - points[7], axis=1)
    assert table.order[0] == 2 and (np.diff(D[table.order]) >= 0).all() and list(table.columns[0]) == [7]
    for i, column in zip(table.order[1:], table.columns[1:]):
        ratio = np.abs(d - D[i]) / D[i]
        assert set(column) == {j for j in np.flatnonzero(ratio < 0.2) if j != 7} and (np.diff(ratio[column]) >= 0).all()


def test_motion_never_mirrors():
    x = np.random.default_rng(1).standard_normal((5, 3))
    e, T = errors(x, x * [1, 1, -1])
    assert np.linalg.det(T) == pytest.approx(1.0) and e.max() > 0.1


def test_a_point_is_matched_once_to_the_closest():
    x = np.array([[0.0, 0, 0], [0.01, 0, 0], [1.0, 0, 0]])
    found = nearest(x, np.eye(4), np.array([[0.011, 0, 0], [5.0, 0, 0]]), np.ones(2, bool), 0.1)
    assert found.tolist() == [-1, 0, -1]


def only(model, segments):
    """The model of some of its segments, parents first."""
    keep = sorted({m for s in segments for m in model.segments[s]})
    return without(model, [m for m in range(len(model)) if m not in keep], segments)


def without(model, labels, segments=None):
    """The model without some labels."""
    segments = range(len(model.segments)) if segments is None else segments
    keep = np.array([m for m in range(len(model)) if m not in labels])
    new, place = {m: i for i, m in enumerate(keep.tolist())}, {s: i for i, s in enumerate(segments)}
    square = np.ix_(keep, keep)
    joints = tuple(
        replace(j, parent=place[j.parent], child=place[j.child], marker=new.get(j.marker))
        for j in model.joints if j.child in place and j.parent in place
    )
    return MarkerModel(
        "part", tuple(model.labels[m] for m in keep), model.reference[keep],
        tuple(tuple(new[m] for m in model.segments[s] if m in new) for s in segments),
        tuple(model.names[s] for s in segments), joints, model.mean[square], model.deviation[square],
        model.low[square], model.high[square],
    )  # fmt: skip


def lost(pose, labels):
    """Points and truth of a pose without some labels."""
    gone = pose.truth[labels]
    kept = np.setdiff1d(np.arange(len(pose.points)), gone)
    truth = np.where(np.isin(pose.truth, gone), -1, np.searchsorted(kept, pose.truth))
    return pose.points[kept], truth


def trunk(points, epsilon, beta):
    """Matches of the trunk alone in a set of points."""
    model = only(synthetic_body(44), [0])
    return list(segment_matches(SapmProblem(model, points, epsilon, beta), 0, -1, np.full(len(model), -1)))


def test_a_match_holds_equation_2():
    x = only(synthetic_body(44), [0]).reference
    rng, length = np.random.default_rng(4), mean_distance(x)
    for size in (0.02, 0.05, 0.1, 0.2):
        y = x + size * length * rng.standard_normal(x.shape)
        mean = errors(x, y)[0].mean()  # of the right correspondence
        for match in trunk(y, 0.1, 0.8):
            here = match >= 0
            assert errors(x[here], y[match[here]])[0].mean() < 0.1 * length
        if mean < 0.05 * length:  # also every distance ratio is within 2 epsilon
            assert any((match == np.arange(len(x))).all() for match in trunk(y, 0.1, 0.8))
    assert not trunk(x * 1.5, 0.1, 0.8)


@pytest.mark.parametrize(("beta", "seen", "found"), [(0.8, 5, True), (0.8, 4, False), (0.6, 4, True), (0.5, 3, False)])
def test_a_match_has_more_than_beta_of_the_points(beta, seen, found):
    x = only(synthetic_body(44), [0]).reference
    matches = trunk(x[:seen], 0.02, beta)
    right = [m for m in matches if (m[:seen] == np.arange(seen)).all() and (m[seen:] < 0).all()]
    assert bool(right) == found and all((m >= 0).sum() > beta * len(x) for m in matches)  # equation 3


def test_the_coarse_update_replaces_the_worst_match():
    x = np.random.default_rng(5).uniform(-0.2, 0.2, (7, 3))
    at = np.vstack([x, x[6] + [0.3, 0.0, 0.0], np.zeros(3)])  # point 7 stands before 6 in the last column
    columns = [np.array([j]) for j in range(6)] + [np.array([7, 6])]
    motions = list(coarse_updates(CandidateTable(np.arange(7), columns), x, at, 0.01))
    assert len(motions) >= 1
    np.testing.assert_allclose(motions[0], np.eye(4), atol=1e-9)
    few = [np.array([j]) for j in range(5)] + [np.array([7]), np.array([6])]  # what has no other candidate is left out
    dropped = list(coarse_updates(CandidateTable(np.arange(7), few), x, at, 0.01))
    np.testing.assert_allclose(dropped[0], np.eye(4), atol=1e-9)


def test_triples_begin_with_the_nearest_and_the_furthest():
    x = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.4]])
    at = np.vstack([x, np.zeros(3)])
    table = CandidateTable(np.arange(4), [np.array([0]), np.array([1, 2]), np.array([2]), np.array([3])])
    tried = list(triples(table, x, at, 1e-6))
    assert len(tried) == 3  # 1 with 3, 1 with 2, 2 with 3; those that take point 2 for 1 miss the limit
    for T in tried:
        np.testing.assert_allclose(se3.apply(T, x), x, atol=1e-9)
    wrong = CandidateTable(np.arange(4), [np.array([0]), np.array([2]), np.array([]), np.array([3])])
    assert not list(triples(wrong, x, at, 0.01))


def test_segments_of_two_points_are_found_with_their_children():
    model = synthetic_body(44)
    middle = [i for i, label in enumerate(model.labels) if label.rpartition("_")[2] in ("shin", "calf")]
    pairs, rng = without(model, middle), np.random.default_rng(6)
    assert [len(s) for s in pairs.segments].count(2) == 2
    below = [i for i, label in enumerate(pairs.labels) if label.rpartition("_")[2] in ("ankle", "heel", "toe")]
    right = 0
    for _ in range(10):
        pose = random_pose(pairs, rng)
        right += bool((sapm(pairs, pose.points)[below] == pose.truth[below]).all())
    assert right >= 8


def test_a_wrong_match_is_corrected_where_its_child_cannot_be_found():
    model = only(synthetic_body(44), [0, 1])  # trunk and head
    pose = random_pose(model, np.random.default_rng(7))
    head = model.segments[1]
    false = pose.points[pose.truth[list(head)]] + [3.0, 0.0, 0.0]  # a second head, that no trunk carries
    subject = SapmProblem(model, np.vstack([pose.points, false]), 0.02, 0.8)
    begun = only(model, [1])
    alone = list(segment_matches(SapmProblem(begun, subject.points, 0.02, 0.8), 0, -1, np.full(5, -1)))
    assert len(alone) >= 2  # the head by itself is found twice
    found, broken = identify_below(subject, 1, -1, np.full(len(model), -1))
    assert not broken and (found == pose.truth).all()


def test_children_of_broken_chains_come_last_without_a_pivot():
    model, rng = synthetic_body(44), np.random.default_rng(8)
    gone = [i for i, label in enumerate(model.labels) if label in ("r_biceps", "r_triceps", "r_shoulder")]
    arm = [i for i, label in enumerate(model.labels) if label in ("r_elbow", "r_radius", "r_ulna", "r_wrist")]
    right = 0
    for _ in range(8):
        points, truth = lost(random_pose(model, rng), gone)  # the upper arm cannot be found
        found = sapm(model, points, epsilon=0.02, beta=0.7)
        right += bool((found[arm] == truth[arm]).all())
    assert right >= 6


def test_poses_without_noise():
    model, rng = synthetic_body(44), np.random.default_rng(2)
    poses = [random_pose(model, rng) for _ in range(25)]
    assert np.mean([(sapm(model, p.points) == p.truth).all() for p in poses]) >= 0.88


def test_a_missing_joint_is_recovered_as_a_virtual_one():
    model = synthetic_body(44)
    pose = random_pose(model, np.random.default_rng(3))
    joint = model.labels.index("neck")
    points = np.delete(pose.points, pose.truth[joint], axis=0)
    truth = np.where(pose.truth > pose.truth[joint], pose.truth - 1, pose.truth)
    truth[joint] = -1
    assert (sapm(model, points, epsilon=0.02, beta=0.7) == truth).all()


def test_bad_points_are_refused():
    with pytest.raises(ObservationError):
        sapm(synthetic_body(44), np.full((4, 3), np.nan))
