"""Subjects found from what their markers do."""

import warnings

import numpy as np
import pytest
from benchmarks.accuracy.closures.closures_swing import HERE, OBSERVED, PRIORS, gear_of, swing

from kinefit import Markers, load_body
from kinefit.bodies import BodyState
from kinefit.bodies.marker_sets import placement
from kinefit.bodies.parts import with_dimensions
from kinefit.errors import KinefitError, ObservationError, TrackingError
from kinefit.fitting.markers.subject import columns, fit_marker_subject, split_people
from kinefit.fitting.tracking.video import fit_markers
from kinefit.readers.markers import read_markers
from kinefit.simulation import squat_and_wave
from kinefit.simulation.evaluation import joint_errors
from kinefit.solving.closed import onto
from kinefit.solving.correspondences.closures import closed_at

BODY = load_body("humanoid")
REAL = {  # file of the folder markers: set that is found, markers of it, stature [m] that a person has
    "momentum/momentum__examples__process_markers_app__02_01.c3d": ("CMU_41", 41),
    "nimblephysics/data__grf__Subject4__MarkerData__walking1.trc": ("STANFORD_47", 47),
    "nimblephysics/data__osim__WeirdFormatTests__markers.trc": ("PIG", 61),
    "nimblephysics/data__osim__HamnerSubject04__subject04__trials__run200__markers.trc": ("HAMNER", 42),
    "nimblephysics/data__c3d__JA1Gait35.c3d": ("SPRINT_51", 51),
    "opensim/Pipelines__Rajagopal__ExpData__motion_capture_walk.trc": ("RAJAGOPAL", 41),
}


@pytest.fixture(scope="module")
def known():
    """A known person who moves, in CMU's markers at places of their own: truth, markers."""
    rng = np.random.default_rng(5)
    truth = squat_and_wave(rate=60)
    placed = placement(truth.body, "CMU_41")
    points = type(placed.points)(
        placed.points.names, placed.points.segments,
        placed.points.points + placed.spread[:, None] * np.clip(rng.normal(size=(len(placed.points), 3)), -1.5, 1.5),
    )  # fmt: skip
    x = truth.positions(points) + rng.normal(0, 0.002, (len(truth), len(points), 3))
    return truth, Markers(points.names, truth.rate, x, up=truth.up)


def test_size_and_offsets_of_a_known_person(known):
    truth, markers = known
    subject = fit_marker_subject(BODY, markers)
    assert subject.marker_set == "CMU_41"
    lengths, found = truth.body.segment_lengths(), subject.body.segment_lengths()
    for bone in ("thigh_r-shank_r", "shank_l-foot_l", "upperarm_r-forearm_r"):
        assert found[bone] == pytest.approx(lengths[bone], abs=0.015)
    motion = fit_markers(subject, markers)
    assert np.sqrt(np.nanmean(motion.residuals["markers"].norms ** 2)) < 0.005
    errors = joint_errors(truth, motion)
    assert errors.mean() < 0.02  # [m] markers are held to slide by 5 mm or more, which these do not


def test_static_and_moving_trials_go_together(known):
    _, markers = known
    still = Markers(markers.names, markers.rate, markers.positions[:10], up=markers.up)
    subject = fit_marker_subject(BODY, [still, markers], frames=30)
    assert subject.frames <= 30
    assert subject.rms < 0.006


def test_hidden_limbs_and_frames_are_bridged(known):
    _, markers = known
    x = np.array(markers.positions)
    arm = [i for i, n in enumerate(markers.names) if n in ("RUPA", "RELB", "RFRM", "RWRA", "RWRB", "RFIN")]
    x[20:40, arm] = np.nan
    x[60:70] = np.nan
    hidden = Markers(markers.names, markers.rate, x, up=markers.up)
    subject = fit_marker_subject(BODY, hidden)
    motion = fit_markers(subject, hidden)
    assert np.isfinite(motion.angles).all()
    whole = fit_markers(subject, markers)
    steps = np.linalg.norm(np.diff(motion.positions(), axis=0), axis=2).max()
    assert steps < 2 * np.linalg.norm(np.diff(whole.positions(), axis=0), axis=2).max()
    assert motion.quality[60:70].max() == 0.0
    hand = motion.body.tree.segment("hand_r")
    assert motion.segment_quality[20:40, hand].max() == 0.0
    assert motion.joint_std[30, hand].max() > 5 * whole.joint_std[30, hand].max()


def test_a_wrong_label_does_not_pull(known):
    _, markers = known
    x = np.array(markers.positions)
    a, b = markers.names.index("RKNE"), markers.names.index("LKNE")
    x[10:20, [a, b]] = x[10:20, [b, a]]
    swapped = Markers(markers.names, markers.rate, x, up=markers.up)
    subject = fit_marker_subject(BODY, swapped)
    motion = fit_markers(subject, swapped)
    whole = fit_markers(subject, markers)
    weights = motion.residuals["markers"].weights[10:20, motion.residuals["markers"].names.index("RKNE")]
    assert weights.max() < 0.1
    knee = motion.body.tree.segment("shank_r")
    centre = (m.segment_poses()[10:20, knee, :3, 3] for m in (motion, whole))
    assert np.linalg.norm(next(centre) - next(centre), axis=1).max() < 0.03


def test_bad_input_is_told(known):
    _, markers = known
    with pytest.raises(ObservationError, match="times the body's size: the unit"):
        fit_marker_subject(BODY, Markers(markers.names, 60.0, markers.positions * 1000))
    two = Markers(
        tuple(f"{p}:{n}" for p in "AB" for n in markers.names), 60.0, np.tile(markers.positions, (1, 2, 1)), up="y"
    )
    with pytest.raises(ObservationError, match="more than one subject"):
        fit_marker_subject(BODY, two)
    assert list(split_people(two)) == ["A", "B"]
    assert split_people(two)["B"].names == markers.names
    for unseen in (markers.positions[:0], np.full_like(markers.positions, np.nan)):
        with pytest.raises(ObservationError, match="none of the markers is visible"):
            fit_marker_subject(BODY, Markers(markers.names, 60.0, unseen))
    few = np.array(markers.positions)
    few[:, 5:] = np.nan
    with pytest.raises(TrackingError, match="5 at most"):
        fit_marker_subject(BODY, Markers(markers.names, 60.0, few))
    with pytest.raises(KinefitError, match="height"):
        fit_marker_subject(BODY, markers, height=180.0)
    with pytest.raises(ObservationError, match="appear twice for A: X"):
        split_people(Markers(("A:X", "A:X", "A:Y", "A:Z"), 60.0, np.zeros((2, 4, 3))))


@pytest.mark.parametrize("name", REAL)
def test_real_takes(data_dir, name):
    markers = read_markers(data_dir("markers") / name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        subject = fit_marker_subject(BODY, markers, frames=30)
        motion = fit_markers(subject, markers)
    assert (subject.marker_set, len(subject.points)) == REAL[name]
    assert 1.5 < subject.body.stature < 2.0
    residuals = motion.residuals["markers"]
    assert (residuals.weights > 0.5).mean() > 0.9
    assert np.sqrt(np.mean(residuals.norms[residuals.weights > 0.5] ** 2)) < 0.012


def test_labels_spelt_otherwise_are_the_same_markers(known):
    _, markers = known
    first = markers.positions[:5]
    other = Markers(tuple(f"Anna:{n.lower()}" for n in markers.names), markers.rate, first, up=markers.up)
    spelt = columns(other, markers.names)
    np.testing.assert_array_equal(spelt, first)
    doubled = Markers((*other.names, "LASI", "lasi"), 60.0, np.zeros((1, len(other.names) + 2, 3)))
    assert columns(doubled, ("LASI",)).shape == (1, 1, 3)  # the one that is spelt as the set has it
    doubled = Markers(("A:lasi", "B:LAsi"), 60.0, np.zeros((1, 2, 3)))
    with pytest.raises(ObservationError, match="more than one subject"):
        columns(doubled, ("LASI",))


def test_gear_is_found_with_lengths_and_offsets_of_markers():
    """A club with markers in two hands: its length, at 10 cm of 90, and no more of the hands' angle than its prior."""
    generic, rng = load_body(HERE / "body.toml"), np.random.default_rng(1)
    true = with_dimensions(generic.scaled(np.full(len(generic.scale_groups), 1.04)), {"club length": 0.78})
    points, tree = placement(true, HERE / "markers.toml").points, true.tree
    sways = 0.3 * np.where(np.isfinite(tree.spread), np.minimum(tree.spread, 0.7), 0.0) * rng.uniform(-1.0, 1.0, (2, 1))
    sways = sways * rng.uniform(-1.0, 1.0, (2, len(tree.usual)))
    closed = lambda state: (closed_at(true, state).value, closed_at(true, state).jacobian)
    x = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False):
        angles = tree.usual + sways[0] * np.sin(phase) + sways[1] * np.cos(phase)
        state, off = onto(true, BodyState(np.eye(4), np.clip(angles, tree.lower, tree.upper)), closed)
        assert off < 1e-6
        x.append(true.positions(state, points) + rng.normal(scale=0.004, size=(len(points), 3)))
    markers = Markers(points.names, 30.0, np.array(x), up="y")
    found = fit_marker_subject(generic, markers, HERE / "markers.toml", frames=12)
    value, std = found.fit.value("gear club length")
    assert value == pytest.approx(0.78, abs=min(2.0 * std, 0.05)) and std < 0.05
    assert {d.name: d.std for d in found.body.dimensions} == dict.fromkeys(PRIORS, 0.0)
    assert found.body.dimensions[0].value == pytest.approx(value)
    assert PRIORS["shaft angle"] > found.fit.value("gear shaft angle")[1] > 0.6 * PRIORS["shaft angle"]


def test_a_real_swing_tells_where_the_club_is_held(data_dir, tmp_path):
    folder = data_dir("markers/btkdata")
    found = gear_of(swing(next(folder.glob("*golfswing.c3d")), tmp_path, 20))
    assert all(found[name][1] < 0.8 * PRIORS[name] for name in OBSERVED)  # 0.23 and 0.70 of it
    assert all(0.0 < std <= PRIORS[name] for name, (_, std) in found.items())
    assert 0.90 < found["club length"][0] < 1.02
