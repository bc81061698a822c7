"""Trackers fixed on the body: their rows against central differences, a known motion, mounts, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, STILL, a_motion
from tests.oracle import STATES, central_differences, state_of

from kinefit import Recording, Tracker, load_body, track
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import BodyTrackerFrame
from kinefit.sensors.points.body_trackers import BodyTrackerSensor
from kinefit.sensors.scene import Scene

POINTS = {
    "root": "torso", "skull": "skull_vertex", "upper_r": "upperarm_r", "wrist_r": "r_wrist", "upper_l": "upperarm_l",
    "wrist_l": "l_wrist", "thigh_r": "thigh_r", "ankle_r": "r_ankle", "thigh_l": "thigh_l", "ankle_l": "l_ankle",
}  # fmt: skip
MOUNTS = {"wrist_r": (0.0, 0.0, np.pi / 2), "root": (0.3, -0.2, 1.0)}
SIGMA, ROTATION_SIGMA = 0.003, 0.01


def sensor(**options):
    given = {"sigma": SIGMA, "rotation_sigma": ROTATION_SIGMA, "mounts": MOUNTS, **options}
    return BodyTrackerSensor("magnetic", POINTS, **given)


def frame(state, time=0.0, rng=None, names=tuple(POINTS), turned=True, slipped=None):
    """What trackers measure of the body in a state; by definition of a mount, from segment poses alone."""
    points = sensor().places(BODY, names)
    T = BODY.tree.segment_poses(np.asarray(state.T_world_root)[None], np.asarray(state.angles)[None])[0]
    T = T[points.segments]
    x = np.einsum("kij,kj->ki", T[:, :3, :3], points.points) + T[:, :3, 3]
    R = T[:, :3, :3] @ np.stack([se3.exp_so3(np.array(MOUNTS.get(n, (0, 0, 0)), float)) for n in names])
    if slipped is not None:
        R = R @ se3.exp_so3(np.asarray(slipped, float))
    if rng is not None:
        x = x + SIGMA * rng.normal(size=x.shape)
        R = R @ se3.exp_so3(ROTATION_SIGMA * rng.normal(size=x.shape))
    return BodyTrackerFrame("magnetic", time, names, x, R if turned else None)


def scene(state):
    return Scene(BODY, state, Rig(()))


@pytest.mark.parametrize("kind", STATES)
@pytest.mark.parametrize("off", [0.0, 1e-7, 0.3, 2.0])
def test_rows_agree_with_central_differences(kind, off):
    state = state_of(BODY, kind, seed=3)
    delta = np.concatenate([np.zeros(3), off * np.array([0.6, 0.0, 0.8]), np.full(BODY.tree.n_dofs - 6, 0.05 * off)])
    matched = sensor().prepare(frame(state.retract(delta)), scene(state)).match(scene(state), 0.03)
    place, turn = matched.rows(scene(state))
    expected = central_differences(lambda s: matched.rows(scene(s))[1].residual, BODY, state)
    assert np.allclose(turn.jacobian, -expected, atol=1e-6)
    assert len(turn) == 3 * len(POINTS) and len(place) == 3 * len(POINTS)
    if off == 0.0:
        assert np.abs(turn.residual).max() < 1e-7 and np.abs(place.residual).max() < 1e-9
    angle = np.linalg.norm(turn.residual[:3]) / (SIGMA / ROTATION_SIGMA)
    assert np.isclose(angle, off, atol=1e-6)  # the root's own tracker is turned by just that


def test_a_known_motion_is_recovered_with_bars_that_hold():
    truth, rng = a_motion(), np.random.default_rng(0)
    steps = [[frame(truth.state(i), i / RATE, rng)] for i in range(30)]
    found = track(Recording.of_frames(steps, Rig(()), rate=RATE, up="y", sensors=[sensor()]), BODY, size=False)
    off = found.angles - truth.angles[:30]
    assert np.degrees(np.sqrt(np.mean(off**2))) < 1.0
    z = off / found.dof_std[:, 6:]
    assert np.isfinite(found.dof_std[:, 6:]).all() and 0.4 < np.sqrt(np.mean(z**2)) < 1.6
    assert list(found.residuals) == ["magnetic"]


def test_a_turn_about_the_limb_is_seen_by_orientation_alone():
    truth = a_motion()
    turn = BODY.tree.coordinates.index("arm_rot_r")
    stds = []
    for turned in (True, False):
        tracker = Tracker(BODY, Rig(()), rate=RATE, settings=STILL, sensors=[sensor()], up="y")
        tracker.start_at(truth.state(0))
        seen = frame(truth.state(0), names=("root", "upper_r"), turned=turned)
        stds.append(tracker.update([seen]).dof_std[6 + turn])
    assert stds[0] < 0.02 < 5 * stds[0] < stds[1]


def test_no_start_is_needed():
    truth, rng = a_motion(), np.random.default_rng(1)
    state = truth.state(0)
    T = se3.transform(se3.exp_so3(np.array([0, 2.5, 0.0])), np.array([3.0, 0, 1]))
    turned = replace(state, T_world_root=T @ state.T_world_root)
    tracker = Tracker(BODY, Rig(()), rate=RATE, sensors=[sensor()], up="y")
    result = tracker.update([frame(turned, rng=rng)])
    names = BODY.landmarks
    assert np.abs(BODY.positions(result.state, names) - BODY.positions(turned, names)).max() < 0.02


def test_mounts_are_estimated():
    truth, rng = a_motion(), np.random.default_rng(2)
    slip = np.array([0.0, 0.2, 0.0])  # every tracker is 11 degrees turned about the limb's axis
    steps = [[frame(truth.state(i), i / RATE, rng, slipped=slip)] for i in range(0, 30, 2)]
    errors = []
    for sigma in (0.0, 0.3):
        recording = Recording.of_frames(steps, Rig(()), rate=RATE / 2, up="y", sensors=[sensor(mount_sigma=sigma)])
        found = track(recording, BODY, size=True, smooth=False)
        elbows = [b.landmarks.select(("r_elbow", "l_elbow")) for b in (found.body, BODY)]
        x = [found.body.positions(found.state(k), elbows[0]) for k in range(15)]
        y = [BODY.positions(truth.state(2 * k), elbows[1]) for k in range(15)]
        errors.append(float(np.mean(np.linalg.norm(np.subtract(x, y), axis=2))))
    assert errors[1] < 0.5 * errors[0]


def test_what_is_refused():
    state = a_motion().state(0)
    with pytest.raises(BodyError, match="tracker 'a'.*no.*'r_wrst'"):
        odd = BodyTrackerFrame("m", 0.0, ("a",), np.zeros((1, 3)))
        BodyTrackerSensor("m", {"a": "r_wrst"}).prepare(odd, scene(state))
    with pytest.raises(ObservationError, match="'b'"):
        BodyTrackerSensor("m", {"a": "r_wrist"}, mounts={"b": (0, 0, 0)})
    for bad in ({"sigma": 0.0}, {"rotation_sigma": -1.0}, {"mount_sigma": np.nan}):
        with pytest.raises(ObservationError, match="positive"):
            sensor(**bad)
    with pytest.raises(ObservationError):
        BodyTrackerFrame("m", 0.0, ("a",), np.zeros((2, 3)))
    with pytest.raises(ObservationError, match="BodyTrackerFrame"):
        sensor().prepare(object(), scene(state))
    unseen = BodyTrackerFrame("magnetic", 0.0, ("root", "elsewhere"), np.full((2, 3), np.nan))
    matched = sensor().prepare(unseen, scene(state)).match(scene(state), 0.03)
    assert len(matched.rows(scene(state))[0]) == 0 and matched.leftovers(scene(state))[0].names == ()


def test_every_catalogue_point_of_h_anim_takes_a_tracker():
    body = load_body("humanoid")
    names = body.landmarks.names
    own = BodyTrackerSensor("m", {name: name for name in names})
    assert np.array_equal(own.places(body, names).points, body.landmarks.points)
