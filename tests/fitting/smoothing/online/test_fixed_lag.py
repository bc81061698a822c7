"""Fixed lag: nearly as near to the truth as the whole take, any sensors, gaps, leaps, and what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fitting.tracking.movements import (
    BODY,
    RATE,
    STILL,
    a_motion,
    a_rig,
    a_tracker,
    depth_frame,
    keypoint_frame,
    off,
)

from kinefit import BodyState, Recording, load_body, track
from kinefit.bodies.tree import twin
from kinefit.errors import ObservationError
from kinefit.fitting.smoothing.online.fixed_lag import FixedLag, KnownNoise
from kinefit.fitting.smoothing.smoother import as_tracked
from kinefit.fitting.smoothing.tracked_frames import TrackedFrames
from kinefit.fitting.smoothing.unwrap import continued, unwrap
from kinefit.fitting.subject.subject import Subject
from kinefit.solving.equations import block_diagonal
from kinefit.solving.trajectory.motion_prior import MotionPrior
from kinefit.solving.trajectory.smoothing import leave, smooth

COLOUR = "left", "right"
SIGMA = dict.fromkeys(COLOUR, 2.0)
N = BODY.tree.n_dofs
CALM = KnownNoise(np.where(np.arange(N) < 3, 4.0, 15.0))
SUBJECT = Subject(BODY, np.ones(len(BODY.scale_groups)))


def seen(i, depth=False, noise=2.0):
    return [keypoint_frame(i, c, noise=noise) for c in COLOUR] + ([depth_frame(i)] if depth else [])


@cache
def tracked(depth, count):
    """A tracker that has done its work, and its results."""
    tracker = a_tracker(sigma=SIGMA)
    return tracker, [tracker.update(seen(i, depth, noise=2.0)) for i in range(count)]


def behind(tracker, results, lag, noise=CALM):
    lagged = FixedLag(tracker, lag, noise=noise)
    return [done for r in results for done in lagged.add(r)] + lagged.finish()


def error(states):
    """[m] root mean square over frames and landmarks, but for the first and the last frames."""
    errors = np.stack([off(state, i) for i, state in enumerate(states)])[3:-4]
    return float(np.sqrt(np.mean(errors**2)))


def whole(tracker, results, noise):
    """The whole take, smoothed with the same noise: states and covariances."""
    kept = [r.kept(tracker.scene_of(r.state, r.time)) for r in results]
    times = np.array([r.time for r in results])
    take = as_tracked(TrackedFrames(kept, times, tracker))
    take = replace(take, angles=unwrap(BODY.tree, take.angles), acceleration=noise.acceleration)
    for _ in range(3):
        take = take.renewed()
        fit, post = take.fit()
        take = replace(take, roots=fit.roots, angles=fit.angles)
    return [BodyState(T, q) for T, q in zip(fit.roots, fit.angles, strict=True)], post


@pytest.mark.parametrize(("depth", "count"), [(False, 60), (True, 24)])
def test_a_tenth_of_a_second_later_is_nearly_as_good_as_the_whole_take(depth, count):
    tracker, results = tracked(depth, count)
    all_at_once, post = whole(tracker, results, CALM)
    done = behind(tracker, results, 0.1)
    assert [r.time for r in done] == [r.time for r in results]
    best, mine, causal = error(all_at_once), error([r.state for r in done]), error([r.state for r in results])
    assert mine < 1.15 * best
    assert mine < 0.85 * causal
    std = np.sqrt(np.einsum("tii->ti", post.frames))[6:-4]
    own = np.stack([r.dof_std for r in done])[6:-4]
    known = np.isfinite(own)
    assert known[:, :6].all() and known.mean() > 0.5
    assert 0.95 < np.median(own[known] / std[known]) < 1.2


def test_a_window_as_long_as_the_take_is_the_whole_take():
    tracker, results = tracked(False, 60)
    states, _ = whole(tracker, results[:20], CALM)
    done = behind(tracker, results[:20], 19 / RATE)
    points = BODY.landmarks
    pairs = [(BODY.positions(r.state, points), BODY.positions(s, points)) for s, r in zip(states, done, strict=True)]
    apart = np.linalg.norm([a - b for a, b in pairs], axis=2)
    assert apart.mean() < 1e-3  # of 4 mm standard deviation; the last frames were solved once


def test_what_left_a_window_is_not_forgotten():
    """With costs that are quadratic, a window that begins later is solved as all frames together are."""
    T, random = 9, np.random.default_rng(0)
    roots, angles = np.tile(np.eye(4), (T, 1, 1)), np.tile(BODY.tree.usual, (T, 1))
    usual, spread = angles[0], BODY.tree.spread
    prior = MotionPrior(np.full(N, 3.0), (0.2, 1.0), 1 / RATE, usual, spread)
    A = random.normal(size=(T, N, N))
    H, g = np.einsum("tij,tkj->tik", A, A) * 1e3, random.normal(size=(T, N))

    def equations(first):
        def make(now, q):
            delta = np.stack([BodyState(np.eye(4), usual).difference(BodyState(*s)) for s in zip(now, q, strict=True)])
            moved = np.einsum("tij,tj->ti", H[first:], delta)
            costs = np.einsum("ti,ti->t", moved, delta) - 2.0 * np.einsum("ti,ti->t", g[first:], delta)
            return np.array(H[first:]), g[first:] - moved, costs

        return make

    full = smooth(BODY, roots, angles, equations(0), prior, dense=True, tolerance=1e-12)
    entering, posture = None, block_diagonal(np.zeros((6, 6)), prior.posture_share - prior.precision)
    for f in range(4):
        own = H[f] + np.diag(np.concatenate([np.zeros(6), 1.0 / spread**2]))
        four = slice(f, f + 4)
        states = roots[four], angles[four]
        entering = leave(BODY, states, own, g[f], posture, np.zeros(N, bool), prior.rows(3), entering)
    rest = smooth(BODY, roots[4:], angles[4:], equations(4), prior, dense=True, tolerance=1e-12, entering=entering)
    np.testing.assert_allclose(rest.angles, full.angles[4:], atol=1e-6)
    np.testing.assert_allclose(rest.roots, full.roots[4:], atol=1e-6)


def test_frames_that_are_missing_are_bridged_and_a_long_gap_begins_anew():
    tracker = a_tracker(sigma=SIGMA)
    lagged, done = FixedLag(tracker, 0.1, noise=CALM), []
    there = [i for i in range(40) if not 10 <= i < 13 and not 22 <= i < 38]
    for i in there:
        new = lagged.add(tracker.update(seen(i)))
        assert all(r.time <= i / RATE for r in new)
        done += new
    assert lagged.add(tracker.update(seen(39))) == []  # the same time again
    done += lagged.finish()
    np.testing.assert_allclose([r.time for r in done], np.array(there) / RATE)
    assert max(off(r.state, i).mean() for r, i in zip(done, there, strict=True)) < 0.03
    assert lagged.finish() == []


def test_a_body_found_elsewhere_is_followed_there_at_once():
    tracker, results = tracked(False, 60)
    moved = []
    for k, r in enumerate(results[:24]):
        T = np.array(r.state.T_world_root)
        if k < 12:
            moved.append(replace(r, matched=()))  # nothing seen; held where it is
            T[:3, 3] += 1.0
            moved[-1] = replace(moved[-1], state=BodyState(T, r.state.angles))
        else:
            moved.append(r)
    done = behind(tracker, moved, 0.1)
    assert off(done[12].state, 12).mean() < 0.05 and off(done[20].state, 20).mean() < 0.02


@given(st.integers(0, 2**32 - 1))
def test_angles_go_on_in_the_nearest_form(seed):
    tree, random = load_body("humanoid").tree, np.random.default_rng(seed)
    before = np.clip(tree.usual + 0.3 * random.normal(size=len(tree.usual)), tree.lower, tree.upper)
    now = before + 0.02 * random.normal(size=len(before))
    given_angles = now.copy()
    for d in tree.ball_joints:
        if random.random() < 0.5:
            given_angles[d] = twin(now[d]) + 2 * np.pi * random.integers(-1, 2, 3)
    out = continued(tree, before, given_angles)
    assert np.abs(out - before).sum() <= np.abs(now - before).sum() + 1e-9
    turns = [tree.segment_poses(np.eye(4)[None], a[None])[..., :3, :3] for a in (out, now)]
    np.testing.assert_allclose(*turns, atol=1e-9)


def recording(count, **more):
    return Recording.of_frames(
        [seen(i) for i in range(count)], a_rig(), rate=RATE, sigma=SIGMA, start=(0, a_motion().state(0)), up="z", **more
    )


def test_track_takes_a_lag_and_another_take_s_noise():
    first = track(recording(40), BODY, subject=SUBJECT, settings=STILL)
    noise = KnownNoise.of_take(BODY, first.provenance)
    motion = track(recording(40), BODY, subject=SUBJECT, settings=STILL, lag=0.1, noise=noise)
    told = motion.provenance["fixed lag"]
    assert motion.provenance["estimate"] == "fixed lag" and told["seconds"] == 0.1
    assert told["acceleration"] == first.provenance["smoothing"]["acceleration"]
    assert told["pixel_sigma"] == first.provenance["smoothing"]["pixel_sigma"]
    causal = track(recording(40), BODY, subject=SUBJECT, settings=STILL, smooth=False)

    def of(m):
        return error([BodyState(T, q) for T, q in zip(m.Ts_world_root, m.angles, strict=True)])

    assert of(motion) < 0.85 * of(causal)
    shorter = track(recording(30), BODY, subject=SUBJECT, settings=STILL, lag=0.1, noise=noise)
    np.testing.assert_allclose(shorter.angles[:26], motion.angles[:26], atol=1e-9)  # knows 0.1 s ahead and no more
    assert np.abs(shorter.angles[29] - motion.angles[29]).max() > 1e-6
    assert all(np.isfinite(r.values).any() for r in motion.residuals.values())


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"lag": 0.001}, "lag is 0.001 s"), ({"lag": np.nan}, "lag is nan s"), ({"lag": 0.5}, "take of 10 frames"),
        ({"lag": 0.1, "contacts": True}, "contacts"), ({"lag": 0.1, "smooth": False}, "smooth=False"),
        ({"noise": CALM}, "needs a lag"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(more, said):
    with pytest.raises(ObservationError, match=said):
        track(recording(10), BODY, subject=SUBJECT, **more)


def test_usual_noise_is_better_than_no_lag_at_all():
    tracker, results = tracked(False, 60)
    assert error([r.state for r in behind(tracker, results, 0.1, None)]) < 0.9 * error([r.state for r in results])


def test_known_noise_is_written_and_read_again_however_small():
    noise = KnownNoise(CALM.acceleration / 700.0)
    again = KnownNoise.of_take(BODY, {"smoothing": noise.as_record(BODY)})
    np.testing.assert_allclose(again.acceleration, noise.acceleration, rtol=1e-3)


def test_noise_of_a_motion_that_was_not_smoothed_is_refused():
    with pytest.raises(ObservationError, match="root_shift"):
        KnownNoise.of_take(BODY, {"estimate": "filtered"})


def test_a_recording_with_depth_is_tracked_with_a_lag():
    frames = [seen(i, depth=True) for i in range(10)]
    taken = Recording.of_frames(frames, a_rig(), rate=RATE, sigma=SIGMA, start=(0, a_motion().state(0)), up="z")
    motion = track(taken, BODY, subject=SUBJECT, settings=STILL, lag=0.1)
    assert set(motion.residuals) == {"depth", *COLOUR} and "sensor noise" in motion.provenance
    states = [BodyState(T, q) for T, q in zip(motion.Ts_world_root, motion.angles, strict=True)]
    assert error(states) < 0.02
