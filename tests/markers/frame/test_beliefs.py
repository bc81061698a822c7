"""What frames tell of the others: labels that a take lacks, and the noise of its segments."""

import numpy as np
import pytest
from benchmarks.papers.markers.synthetic_points import random_pose, synthetic_body

from kinefit.markers.frame.identify import identify
from kinefit.markers.frame.search import LabelSearch, UnlabelledFrame
from kinefit.markers.frame.tables import MAX_NOISE, MIN_NOISE, Beliefs, learn_beliefs, segment_tables


def frames_without(body, label, count, distortion=0.02):
    """Points and truth of poses in which one label is never seen."""
    rng, out = np.random.default_rng(0), []
    for _ in range(count):
        pose = random_pose(body, rng, distortion=distortion)
        kept = np.setdiff1d(np.arange(len(pose.points)), [pose.truth[label]])
        truth = np.where(pose.truth == pose.truth[label], -1, np.searchsorted(kept, pose.truth))
        out.append((pose.points[kept], truth))
    return out


def test_a_label_that_a_take_lacks_is_believed_absent():
    body = synthetic_body(44)
    label = body.labels.index("r_heel")
    frames = frames_without(body, label, 8)
    known = learn_beliefs(body, [(p, identify(body, p)) for p, _ in frames])
    assert known.presence[label] < 0.2 < 0.9 < np.delete(known.presence, label).min()
    assert known.odds[label] < -3
    for points, truth in frames:
        found = identify(body, points, beliefs=known).assignment
        assert found[label] < 0 and (found == truth).mean() > 0.95


def test_a_name_costs_what_its_absence_makes_it():
    body = synthetic_body(44)
    toe, pose = body.labels.index("r_toe"), random_pose(body, np.random.default_rng(1), distortion=0.02)
    foot = next(s for s, members in enumerate(body.segments) if toe in members)
    tables, noise, usual = segment_tables(body, 0), np.ones(len(body.segments)), np.full(len(body), 0.95)
    absent = Beliefs(np.where(np.arange(len(body)) == toe, 0.3, usual), noise)
    gaps = np.linalg.norm(pose.points[:, None] - pose.points, axis=-1)
    told = [None, Beliefs(usual, noise), absent, Beliefs(usual, 2 * noise)]
    search = [LabelSearch(tables, UnlabelledFrame(pose.points, gaps, 10.0, 12.0, 4.5, beliefs=b), 1.0) for b in told]
    cost = [one.search_alone(one.by_index[foot])[0] for one in search]
    assert cost[1] == pytest.approx(cost[0]) and cost[3] > cost[0]
    assert cost[2] - cost[0] == pytest.approx(-absent.odds[toe], abs=1e-6)


def test_noise_is_found_for_each_segment_within_bounds():
    body, rng = synthetic_body(44), np.random.default_rng(2)
    large = int(np.argmax([len(s) for s in body.segments]))
    noisy = []
    for _ in range(8):
        pose = random_pose(body, rng)
        points = pose.points.copy()
        for s, members in enumerate(body.segments):
            sigma = 0.03 if s == large else 0.0005
            points[pose.truth[list(members)]] += sigma * rng.standard_normal((len(members), 3))
        noisy.append((points, identify(body, points)))
    noise = learn_beliefs(body, noisy).noise
    assert noise[large] > 1.5 * np.median(noise) and MIN_NOISE <= noise.min() and noise.max() <= MAX_NOISE
