"""A rig set right by the body that it saw."""

from dataclasses import replace

import numpy as np
import pytest
from tests.rigs.people_data import BODY, errors, room, seen, walker

from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.rigs.refine.gauge import aligned, covariance_in_gauge, generators, resized
from kinefit.rigs.refine.refine import refine
from kinefit.rigs.refine.result import PersonTrial, correlation_time, residual_correlation, shifted, sight
from kinefit.simulation import simulate_keypoints
from kinefit.solving.bundle.cameras import COLUMNS, camera_jacobian, moved_rig


def knocked(rig, seed=0, degrees=0.6, metres=0.03):
    random = np.random.default_rng(seed)
    delta = np.zeros((len(rig), COLUMNS))
    delta[:, :3] = metres * random.normal(size=(len(rig), 3))
    delta[:, 3:6] = np.radians(degrees) * random.normal(size=(len(rig), 3))
    return moved_rig(rig, delta)


@pytest.fixture(scope="module")
def refined():
    return refine(knocked(room()), seen(), BODY, sigma=2.0)


def test_a_knocked_rig_comes_back(refined):
    before, after = errors(knocked(room()), room()), errors(refined.rig, room())
    assert before[0] > 0.4 and before[1] > 20
    assert after[0] < 0.1 and after[1] < 8
    assert refined.confident
    assert np.mean([c.residual_before for c in refined.cameras.values()]) > 3.0
    for change in refined.cameras.values():
        assert change.residual_after < 2.3
        assert np.linalg.norm(change.bias_after) < 1.0
        assert change.time == change.time_std == change.focal == change.focal_std == 0.0


def test_its_error_bars_are_as_large_as_its_errors(refined):
    turn, place = errors(refined.rig, room())
    stated = list(refined.cameras.values())
    assert 0.3 * turn < np.degrees(max(c.turn_std for c in stated)) < 10 * turn + 0.1
    assert 0.3 * place < 1e3 * max(c.shift_std for c in stated) < 10 * place + 10


def test_the_world_stays_the_old_calibrations(refined):
    old = knocked(room())
    _, T, factor = aligned(refined.rig, old)
    np.testing.assert_allclose(T, np.eye(4), atol=1e-6)
    assert factor == pytest.approx(1.0, abs=1e-6)
    assert "old calibration" in refined.gauge


def test_what_it_tells_names_every_camera(refined):
    text = "\n".join(refined.summary_lines())
    assert all(name in text for name in room().names) and "px" in text and "nan" not in text


@pytest.mark.slow
def test_a_height_or_a_length_sets_the_scale():
    wide = resized(knocked(room()), 1.1)
    by_height = refine(wide, seen(), BODY, sigma=2.0, height=BODY.stature)
    assert aligned(by_height.rig, room())[2] == pytest.approx(1.0, abs=0.02)
    thigh = walker().positions(BODY.keypoints("BODY_25B").select(("RHip", "RKnee")))
    true = np.linalg.norm(np.diff(thigh, axis=1), axis=-1)
    by_length = refine(wide, seen(), BODY, sigma=2.0, known_length=("RHip", "RKnee", float(true.mean())))
    assert aligned(by_length.rig, room())[2] == pytest.approx(1.0, abs=0.03)
    assert "RHip to RKnee" in by_length.gauge


def test_static_points_join():
    random = np.random.default_rng(1)
    x = np.column_stack([random.uniform(-1.5, 1.5, (8, 2)), random.uniform(0, 1.8, 8)])
    points = {f"p{k}": {c.name: tuple(c.project(x[k])) for c in room()} for k in range(8)}
    found = refine(knocked(room()), seen(), BODY, sigma=2.0, static_points=points)
    assert max(found.static.values()) < 1.0
    rig = aligned(found.rig, room())[0]
    left = np.concatenate([camera.project(x) - rig[camera.name].project(x) for camera in room()])
    assert np.median(np.linalg.norm(left, axis=1)) < 1.5


@pytest.mark.slow
def test_clocks_are_found_to_a_fraction_of_a_frame():
    """The take has one and a half slow seconds; see benchmarks/accuracy/video/calibrate.py for longer ones."""
    late = (0.0, 2.3, -0.6, 0.0)
    keypoints = [shifted(k, -f / 30.0) for k, f in zip(seen(), late, strict=True)]
    found = refine(room(), keypoints, BODY, sigma=2.0, time_offsets=True)
    np.testing.assert_allclose([30.0 * t for t in found.time_offsets.values()], late, atol=0.2)


@pytest.mark.slow
def test_focal_lengths_are_found_on_request():
    wrong = Rig(
        tuple(replace(c, matrix=c.matrix * np.array([[f, 1, 1], [1, f, 1], [1, 1, 1]]))
              for c, f in zip(room(), (1.02, 0.98, 1.0, 1.01), strict=True))
    )  # fmt: skip
    found = refine(wrong, seen(), BODY, sigma=2.0, focal=True)
    for camera, true in zip(found.rig, room(), strict=True):
        assert camera.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=0.006)
        assert camera.matrix[0, 2] == true.matrix[0, 2]


# what is refused


@pytest.mark.slow
def test_exchanged_cameras_are_named():
    names = room().names
    swapped = Rig(tuple(replace(room().cameras[k], name=n) for k, n in zip((0, 2, 1, 3), names, strict=True)))
    with pytest.raises(CalibrationError, match="two cameras are swapped"):
        refine(swapped, seen(), BODY, sigma=2.0)


def test_a_person_who_hardly_moves_is_too_little():
    motion = walker(reach=0.0)
    still = replace(motion, Ts_world_root=np.repeat(motion.Ts_world_root[:1], len(motion), axis=0),
                    angles=np.repeat(motion.angles[:1], len(motion), axis=0))  # fmt: skip
    keypoints = simulate_keypoints(still, room(), "BODY_25B", noise_px=1.0, outliers=0, missing=0, drift_px=12.0,
                                   drift_time=60.0, seed=3)  # fmt: skip
    try:
        found = refine(knocked(room()), keypoints, BODY)
    except CalibrationError as error:
        assert "too little motion" in str(error) and "Record someone" in str(error)
    else:
        assert not found.confident


def test_too_few_frames_are_refused():
    few = [replace(k, points=k.points[:6], confidence=k.confidence[:6]) for k in seen()]
    with pytest.raises(CalibrationError, match="only 6 of 6 frames"):
        refine(room(), few, BODY, sigma=2.0)


def test_impossible_wishes_are_refused():
    with pytest.raises(CalibrationError, match="no keypoints of camera cam04"):
        refine(room(), seen()[:3], BODY)
    with pytest.raises(ObservationError, match="length of 0 m"):
        refine(room(), seen(), BODY, known_length=("RHip", "RKnee", 0.0))
    with pytest.raises(ObservationError, match="height of 17"):
        refine(room(), seen(), BODY, height=17.0)
    shorter = replace(seen()[0], points=seen()[0].points[:-1], confidence=seen()[0].confidence[:-1])
    with pytest.raises(ObservationError, match="streams differ"):
        refine(room(), [shorter, *seen()[1:]], BODY)
    with pytest.raises(ObservationError, match="static point"):
        refine(room(), seen(), BODY, static_points={"p": {"cam01": (1.0, 2.0)}})
    with pytest.raises(CalibrationError, match="cam09"):
        refine(room(), seen(), BODY, static_points={"p": {"cam01": (1.0, 2.0), "cam09": (1.0, 2.0)}})


# gauge


def test_a_similarity_is_undone():
    T = se3.exp(np.array([0.3, -1.0, 2.0, 0.4, -0.8, 0.2]))
    rig, T_old_new, factor = aligned(resized(room(), 0.7).moved(T), room())
    for a, b in zip(rig, room(), strict=True):
        np.testing.assert_allclose(a.T_camera_world, b.T_camera_world, atol=1e-9)
    assert factor == pytest.approx(1 / 0.7)
    x = np.array([0.3, 0.2, 1.0])
    np.testing.assert_allclose(se3.apply(T_old_new, factor * se3.apply(T, 0.7 * x)), x, atol=1e-9)


def test_generators_leave_the_pictures():
    rig, x = room(), np.random.default_rng(0).uniform(-0.5, 1.0, (5, 3))
    G = generators(rig).reshape(len(rig), COLUMNS, 7)
    for c, camera in enumerate(rig):
        _, J_point = camera.project_with_jacobian(x)
        moves = np.concatenate([np.tile(np.eye(3), (5, 1, 1)), -se3.hat(x), x[:, :, None]], axis=2)
        total = camera_jacobian(camera, x) @ G[c] + J_point @ moves
        assert np.abs(total).max() < 1e-8 * np.abs(J_point).max()


def test_the_gauge_has_no_share_in_the_covariance():
    rig, random = room(), np.random.default_rng(0)
    free = np.tile(np.arange(COLUMNS) < 6, len(rig))
    A = random.normal(size=(60, len(free))) * free
    G = generators(rig)
    A -= (A @ G) @ np.linalg.pinv(G)
    C = covariance_in_gauge(rig, A.T @ A, free)
    assert np.all(C[~free] == 0) and np.linalg.matrix_rank(C, tol=1e-12) <= free.sum() - 7
    np.testing.assert_allclose(A @ C @ A.T @ A, A, atol=1e-6)


# sightings


def test_shifted_keypoints_are_those_of_another_time():
    record = seen()[0]
    whole = shifted(record, 2 / 30.0)
    np.testing.assert_array_equal(whole.points[2:], record.points[:-2])
    assert np.isnan(whole.points[:2]).all() and not whole.confidence[:2].any()
    half = shifted(record, 0.5 / 30.0)
    np.testing.assert_allclose(half.points[5], 0.5 * (record.points[4] + record.points[5]))
    assert shifted(record, 0.0) is record


def test_correlation_time_of_errors_that_last():
    random = np.random.default_rng(0)
    white = random.normal(size=(400, 30, 2))
    lasting = np.zeros_like(white)
    for f in range(1, 400):
        lasting[f] = 0.9 * lasting[f - 1] + np.sqrt(1 - 0.81) * white[f]
    assert correlation_time(white) < 1.5
    assert 12 < correlation_time(lasting[50:]) < 28  # (1 + 0.9) / (1 - 0.9) = 19
    assert correlation_time(np.ones((50, 3, 2))) == pytest.approx(50, rel=0.05)


def test_independent_errors_are_not_together():
    sighting = sight(room(), PersonTrial(seen(), BODY, "z", 2.0), {})
    assert residual_correlation(sighting) < 0.2
    c = sighting.channels
    group = c.source * 100 + c.points.segments[c.column]
    common = np.random.default_rng(0).normal(size=(len(sighting.motion), group.max() + 1, 2))[:, group]
    residuals = {
        name: replace(r, values=5.0 * common[:, c.source == q], weights=np.ones_like(r.weights))
        for q, (name, r) in enumerate(sighting.motion.residuals.items())
    }
    same = replace(sighting, motion=replace(sighting.motion, residuals=residuals))
    assert residual_correlation(same) > 0.95
