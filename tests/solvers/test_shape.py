"""Bone lengths and the places of a detector's points, from pixels of many frames."""

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, PointSet, load_body
from kinefit.solvers.shape import PixelFrames, fit_shape, mirror_points

BODY = load_body("humanoid")
SET = BODY.keypoints("BODY_25B")
RIG = rig_around((0.0, 0.0, 0.0), cameras=4)
GROUPS = BODY.scale_groups


def person(seed=0):
    """Scales, and shifts (K, 3) of the detector's points: the same left and right."""
    random = np.random.default_rng(seed)
    scales = 1.03 * random.uniform(0.9, 1.12, len(GROUPS))
    lead, sign = mirror_points(SET, BODY.tree.segments)
    shifts = random.normal(scale=0.01, size=(len(SET), 3))[lead]
    shifts[:, 2] *= sign
    return scales, shifts


def seen(scales, shifts, frames=20, noise=2.0, seed=0):
    """Postures near the origin, and their pixels in four cameras."""
    random = np.random.default_rng(seed)
    body = BODY.scaled(scales)
    points = PointSet(SET.names, SET.segments, body.keypoints("BODY_25B").points + shifts)
    states = []
    for k in range(frames):
        state = posture(BODY, 100 + k, 0.35)
        T = np.array(state.T_world_root)
        T[:3, 3] *= 0.2
        states.append(BodyState(T, state.angles))
    x = np.stack([body.positions(s, points) for s in states])
    uv = np.concatenate([c.project(x) for c in RIG], axis=1)
    uv += noise * random.normal(size=uv.shape)
    count = len(SET)
    camera, column = np.repeat(np.arange(4), count), np.tile(np.arange(count), 4)
    weight = np.full(uv.shape[:2], max(noise, 0.5) ** -2)
    return PixelFrames(SET, camera, column, uv, weight), states, x


def lengths(scales):
    return np.array(list(BODY.scaled(scales).segment_lengths().values()))


@pytest.mark.parametrize(("shifted", "lengths_within"), [(False, 0.004), (True, 0.008)])
def test_a_known_person_comes_back(shifted, lengths_within):
    """From 20 frames of four cameras with 2 px of noise (9 mm at the person): points to 9 mm, lengths to 4 mm.

    Where the detector's points sit 1 cm beside the joints to every side, the lengths to 8 mm: a bone that both its
    points lengthen looks the same as a longer bone.
    """
    scales, shifts = person()
    shifts = shifts * shifted
    pixels, states, x = seen(scales, shifts)
    start = [s.retract(np.random.default_rng(k).normal(scale=0.03, size=47)) for k, s in enumerate(states)]
    shape = fit_shape(BODY, RIG, pixels, start, np.full(len(GROUPS), 1.0))
    body = BODY.scaled(shape.scales)
    points = PointSet(SET.names, SET.segments, body.keypoints("BODY_25B").points + shape.shifts)
    found = np.stack([body.positions(s, points) for s in shape.states])
    assert np.linalg.norm(found - x, axis=-1).mean() < 0.009
    assert np.abs(lengths(shape.scales) - lengths(scales)).mean() < lengths_within
    limbs = [GROUPS.index(name) for name in ("thigh", "shank", "upperarm", "forearm")]
    np.testing.assert_allclose(shape.scales[limbs], scales[limbs], rtol=0.06 if shifted else 0.02)


def test_a_length_that_nobody_sees_follows_the_others():
    pixels, states, _ = seen(np.full(len(GROUPS), 1.12), np.zeros((len(SET), 3)), frames=8)
    weight = np.array(pixels.weight)
    weight[:, np.isin(pixels.column, [k for k, n in enumerate(SET.names) if "Knee" in n or "Ankle" in n])] = 0.0
    weight[:, np.isin(pixels.column, [k for k, n in enumerate(SET.names) if "Toe" in n or "Heel" in n])] = 0.0
    legless = PixelFrames(SET, pixels.camera, pixels.column, pixels.uv, weight)
    scales = fit_shape(BODY, RIG, legless, states, np.ones(len(GROUPS))).scales
    assert scales[GROUPS.index("shank")] == pytest.approx(1.12, abs=0.03)
    told = fit_shape(BODY, RIG, legless, states, np.ones(len(GROUPS)), whole=1.05).scales
    assert told[GROUPS.index("shank")] < scales[GROUPS.index("shank")]


def test_left_and_right_are_alike():
    scales, shifts = person(1)
    pixels, states, _ = seen(scales, shifts, frames=6)
    shape = fit_shape(BODY, RIG, pixels, states, np.ones(len(GROUPS)))
    fitted = BODY.scaled(shape.scales)
    told = fitted.segment_lengths()
    for name, length in told.items():
        mirrored = name.replace("_r", "_L").replace("_l", "_r").replace("_L", "_l")
        assert told[mirrored] == pytest.approx(length, abs=1e-12)
    for k, name in enumerate(SET.names):
        if name[0] in "LR" and name[1].isupper():
            other = SET.index(("R" if name[0] == "L" else "L") + name[1:])
            np.testing.assert_allclose(shape.shifts[k], shape.shifts[other] * (1, 1, -1), atol=1e-12)
    assert np.abs(shape.shifts).max() < 0.06 and np.abs(shape.shifts).max() > 1e-4


def test_exact_pixels_of_a_body_of_usual_shape_leave_it_as_it_is():
    pixels, states, _ = seen(np.ones(len(GROUPS)), np.zeros((len(SET), 3)), frames=5, noise=0.0)
    shape = fit_shape(BODY, RIG, pixels, states, np.ones(len(GROUPS)))
    np.testing.assert_allclose(shape.scales, 1, atol=0.02)
    np.testing.assert_allclose(shape.shifts, 0, atol=0.004)


def test_outliers_hardly_matter():
    scales, shifts = person(2)
    pixels, states, _ = seen(scales, shifts, frames=12)
    random = np.random.default_rng(0)
    wrong = random.random(pixels.weight.shape) < 0.1
    uv = np.where(wrong[..., None], pixels.uv + random.uniform(50, 200, (*wrong.shape, 1)), pixels.uv)
    spoilt = PixelFrames(pixels.points, pixels.camera, pixels.column, uv, pixels.weight)
    clean, robust = (fit_shape(BODY, RIG, p, states, np.ones(len(GROUPS))) for p in (pixels, spoilt))
    limbs = [GROUPS.index(n) for n in ("thigh", "shank", "upperarm", "forearm")]
    np.testing.assert_allclose(robust.scales[limbs], clean.scales[limbs], atol=0.02)


def test_what_was_not_seen_does_not_matter():
    scales, shifts = person(3)
    pixels, states, _ = seen(scales, shifts, frames=5)
    uv, weight = np.array(pixels.uv), np.array(pixels.weight)
    weight[:, ::5] = 0.0
    shapes = []
    for filler in (np.nan, 0.0):
        uv[:, ::5] = filler
        shapes.append(
            fit_shape(
                BODY, RIG, PixelFrames(SET, pixels.camera, pixels.column, uv, weight), states, np.ones(len(GROUPS))
            )
        )
    np.testing.assert_allclose(shapes[0].scales, shapes[1].scales, atol=1e-12)
    assert np.all(np.isfinite(shapes[0].scales))


def test_angles_stay_within_their_limits():
    scales, shifts = person(4)
    pixels, states, _ = seen(scales, shifts, frames=5, noise=8.0)
    for state in fit_shape(BODY, RIG, pixels, states, np.ones(len(GROUPS))).states:
        assert np.all(state.angles >= BODY.tree.lower) and np.all(state.angles <= BODY.tree.upper)


def test_the_cost_falls_with_more_iterations():
    scales, shifts = person(5)
    pixels, states, _ = seen(scales, shifts, frames=5)
    costs = [
        fit_shape(BODY, RIG, pixels, states, np.ones(len(GROUPS)), max_iterations=n, tolerance=0).cost
        for n in (0, 1, 3, 8)
    ]
    assert costs[0] > costs[1] > costs[2] >= costs[3] > 0


def test_a_fixed_root_stays():
    arm = load_body("arm")
    points = arm.keypoints("MEDIAPIPE_33")
    states = [posture(arm, k, 0.3) for k in range(4)]
    rig = rig_around((0.0, 0.0, 0.0), distance=3.0)
    x = np.stack([arm.scaled(np.full(len(arm.scale_groups), 1.1)).positions(s, points) for s in states])
    uv = np.concatenate([c.project(x) for c in rig], axis=1)
    count = len(points)
    pixels = PixelFrames(
        points, np.repeat(np.arange(4), count), np.tile(np.arange(count), 4), uv, np.ones(uv.shape[:2])
    )
    for before, after in zip(
        states, fit_shape(arm, rig, pixels, states, np.ones(len(arm.scale_groups))).states, strict=True
    ):
        np.testing.assert_array_equal(after.T_world_root, before.T_world_root)


# which points share a shift

SEGMENTS = ("trunk", "leg_r", "leg_l", "foot_r")


def shared(*points):
    segments = [SEGMENTS.index(s) for s, _ in points]
    return mirror_points(PointSet(tuple(map(str, range(len(points)))), segments, [x for _, x in points]), SEGMENTS)


def test_mirrored_points_of_two_limbs_share_a_shift():
    lead, sign = shared(
        ("leg_l", (0.1, 0.2, -0.03)), ("leg_r", (0.1, 0.2, 0.03)), ("leg_r", (0.0, 0.0, 0.0)), ("leg_l", (0, 0, 0))
    )
    assert list(lead) == [1, 1, 2, 2] and list(sign) == [-1, 1, 1, -1]


def test_points_of_the_trunk_share_across_its_middle():
    lead, sign = shared(("trunk", (0.0, 0.5, 0.1)), ("trunk", (0.0, 0.5, -0.1)), ("trunk", (0.1, 0.6, 0.0)))
    assert list(lead) == [0, 0, 2] and list(sign) == [1, -1, 0]


def test_a_point_without_a_partner_is_its_own():
    lead, sign = shared(
        ("leg_l", (0.1, 0.2, -0.03)), ("foot_r", (0.0, 0.1, 0.0)), ("trunk", (0, 0.5, 0.1)), ("trunk", (0, 0.4, -0.1))
    )
    assert list(lead) == [0, 1, 2, 3] and list(sign) == [1, 1, 1, 1]


def test_two_detectors_points_at_one_place_pair_in_order():
    spot_r, spot_l = ("leg_r", (0.1, 0.2, 0.03)), ("leg_l", (0.1, 0.2, -0.03))
    lead, sign = shared(spot_r, spot_l, spot_r, spot_l)
    assert list(lead) == [0, 0, 2, 2] and list(sign) == [1, -1, 1, -1]


def test_every_sided_keypoint_of_the_humanoid_has_its_partner():
    for name, points in BODY.keypoint_sets.items():
        lead, sign = mirror_points(points, BODY.tree.segments)
        for k, point in enumerate(points.names):
            left = "left" in point or (point[0] == "L" and point[1].isupper())
            assert (sign[k] == -1) == left, (name, point)
            assert sign[lead[k]] != -1
