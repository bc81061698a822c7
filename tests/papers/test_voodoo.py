"""VooDoo's steps, each against what the paper says of it, and the whole on points of a known body."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces.places import nearest, sample
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame, PointCloud
from kinefit.papers import _voodoo_boxes as boxing
from kinefit.papers import _voodoo_motion as motion
from kinefit.papers import _voodoo_steps as steps
from kinefit.papers._voodoo_input import sight_of
from kinefit.papers.voodoo import Settings, voodoo
from kinefit.solving.correspondences import joint_bands

BODY = load_body("humanoid10")
STATE = BODY.default_state()
FRAMES, _ = BODY.tree.forward(STATE.T_world_root, STATE.angles)
BOXES = boxing.boxes_of(BODY)
CAMERA = Camera("cam", (160, 120), np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]), (), "radtan",
                np.array([[0, 0, 1.0, 0], [0, -1, 0, 0], [1, 0, 0, 4], [0, 0, 0, 1]]))  # fmt: skip
RIG = Rig((CAMERA,))


def skin(count=2000, state=STATE, seed=0):
    """Points on the body's surface, and their segments."""
    rest, _, segment = sample(BODY, count, seed=seed)
    frames, _ = BODY.tree.forward(state.T_world_root, state.angles)
    f = frames[segment]
    return (f[:, :9].reshape(-1, 3, 3) @ rest[:, :, None])[..., 0] + f[:, 9:], segment


def test_the_bodys_own_points_are_in_its_boxes():
    x, segment = skin()
    assert boxing.in_body_box(x, BOXES, FRAMES, 1e-9).all()
    depth = boxing.depth_in_boxes(x, BOXES, FRAMES, 1e-9)
    assert (depth[np.arange(len(x)), segment] >= 0.0).all()
    np.testing.assert_allclose(boxing.depth_in_boxes(x, BOXES, FRAMES, 0.1) - depth, 0.1, atol=1e-8)


def test_the_body_box_is_enlarged_by_what_is_asked_for():
    x, _ = skin(20000)
    below = x[np.argmin(x[:, 1])] - [0.0, 0.3, 0.0]
    assert not boxing.in_body_box(below[None], BOXES, FRAMES, 0.15)[0]
    assert boxing.in_body_box(below[None], BOXES, FRAMES, 0.3)[0]


def test_the_three_rules_of_overlap():
    forearm, upper, thigh = (BODY.tree.segment(n) for n in ("forearm_r", "upperarm_r", "thigh_r"))
    depth = np.full((1, len(FRAMES)), -1.0)
    depth[0, [forearm, upper, thigh]] = 0.05, 0.02, 0.01
    allowed = {rule: set(np.flatnonzero(boxing.assigned(depth, BOXES, rule)[0]))
               for rule in ("shared", "exclusive", "adjacent")}  # fmt: skip
    assert allowed == {"shared": {forearm, upper, thigh}, "exclusive": {forearm}, "adjacent": {forearm, upper}}
    assert not boxing.assigned(np.full((1, len(FRAMES)), -1.0), BOXES, "exclusive").any()


def test_points_become_fewer_limb_by_limb():
    member = np.zeros((1000, 3), bool)
    member[:800, 0] = member[800:990, 1] = member[990:, 2] = True
    point, limb = steps.fewer(member, factor=4.0, minimum=60, maximum=150)
    assert np.bincount(limb).tolist() == [150, 60, 10]
    assert member[point, limb].all() and len(set(point)) == len(point)


def test_closest_points_are_of_their_limb_and_within_the_bound():
    x, segment = skin(500)
    _, normals, _ = sample(BODY, 500, seed=0)
    away = x + 0.03 * (FRAMES[segment][:, :9].reshape(-1, 3, 3) @ normals[:, :, None])[..., 0]
    pairs = steps.closest_points(BODY, FRAMES, away, np.arange(500.0), segment, 0.05)
    np.testing.assert_array_equal(pairs.limb, segment)
    np.testing.assert_array_equal(pairs.weight, np.arange(500.0))
    expected = nearest(BODY, STATE, away, max_distance=0.05, only=segment).point
    np.testing.assert_allclose(pairs.source, expected, atol=1e-12)
    assert len(steps.closest_points(BODY, FRAMES, away, np.ones(500), segment, 1e-3).limb) < 50


def test_the_nearest_points_of_rays():
    points = BODY.landmarks.select(("nose_tip", "r_wrist"))
    x = BODY.positions(STATE, points)
    n = np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    off = np.array([[0.8, -0.6, 0.0], [1.0, 0.0, 0.0]]) * 0.07
    lines = np.concatenate([n, np.cross(x + off + 3.0 * n, n)], axis=1)
    pairs = steps.points_on_lines(BODY, FRAMES, points, lines, np.array([30.0, 20.0]))
    np.testing.assert_allclose(pairs.target - pairs.source, off, atol=1e-12)
    lines[0] = np.nan
    assert steps.points_on_lines(BODY, FRAMES, points, lines, np.array([30.0, 20.0])).weight.tolist() == [20.0]


def test_quality_is_the_weighted_mean_square():
    x = np.zeros((2, 3))
    pairs = steps.Pairs(x, np.array([[0.1, 0, 0], [0, 0.2, 0]]), np.array([3.0, 1.0]), np.zeros(2, int))
    np.testing.assert_allclose(steps.quality(pairs), (3 * 0.01 + 0.04) / 4)
    assert steps.quality(steps.Pairs(x[:0], x[:0], np.zeros(0), np.zeros(0, int))) == 0.0


def test_five_inputs_are_told_apart():
    depth = np.zeros((120, 160))
    depth[60, 80] = 4.0
    x = np.arange(9.0).reshape(3, 3)
    seen = (
        DepthFrame("cam", 0.0, depth), PointCloud("laser", 0.0, x), PointCloud("suit", 0.0, x[:2], on_body=True),
        PointCloud("glove", 0.0, x[:1], segment="forearm_r"),
        MarkerFrame("mocap", 0.0, ("r_knee", "nobody"), x[:2]),
        KeypointFrame("cam", 0.0, ("nose_tip", "r_wrist"), [[80.0, 60.0], [np.nan, np.nan]], [1.0, 0.0]),
    )  # fmt: skip
    sight = sight_of(seen, BODY, RIG, {"laser": 2.0, "nose_tip": 30.0, "mocap": 5.0})
    np.testing.assert_allclose(sight.free[0], [0.0, 0.0, 0.0], atol=1e-12)  # 4 m before the camera
    assert sight.free_weight.tolist() == [1.0, 2.0, 2.0, 2.0] and len(sight.on_body) == 2
    assert sight.limb.tolist() == [BODY.tree.segment("forearm_r")]
    assert sight.points.names == ("r_knee",) and sight.places_weight.tolist() == [5.0]
    assert sight.features.names == ("nose_tip", "r_wrist") and sight.lines_weight.tolist() == [30.0, 1.0]
    np.testing.assert_allclose(sight.lines[0], [1, 0, 0, 0, 0, 0], atol=1e-12)
    assert np.isnan(sight.lines[1]).all()
    with pytest.raises(ObservationError, match="weight of cam is -1"):
        sight_of(seen, BODY, RIG, {"cam": -1.0})


def moved(angle):
    """The body with an arm flexed and a knee bent."""
    angles = np.array(STATE.angles)
    angles[BODY.tree.coordinate("arm_flex_r")] += angle
    angles[BODY.tree.coordinate("knee_angle_l")] += angle
    return replace(STATE, angles=angles)


def test_a_body_all_of_whose_skin_is_seen_is_found():
    """Every point told its limb: bands and Horn's step alone find the pose."""
    truth = moved(0.3)
    x, segment = skin(4000, truth)
    seen = [PointCloud("scan", 0.0, x[segment == s], segment=name) for s, name in enumerate(BODY.tree.segments)]
    settings = Settings(factor=1.0, maximum=400, quality=1e-8, steps=(0, 60))
    (fit,) = voodoo([seen], BODY, STATE, RIG, settings)
    frames, _ = BODY.tree.forward(truth.T_world_root, truth.angles)
    for name in ("r_wrist", "l_ankle", "neck", "r_elbow"):
        points = BODY.landmarks.select((name,))
        found, true = (steps.places(BODY, f, points) for f in (fit.frames, frames))
        np.testing.assert_allclose(found, true, atol=0.015)
    assert fit.steps == 60 or fit.quality <= 1e-8


def test_a_good_fit_stops_at_once_and_the_steps_are_counted():
    x, _ = skin(500)
    near, spent = (next(iter(voodoo([[PointCloud("s", 0.0, x)]], BODY, STATE, RIG, Settings(quality=q, steps=(0, 4)))))
                   for q in (1e-3, 0.0))  # fmt: skip
    assert near.steps == 0 and np.array_equal(near.frames, FRAMES)
    assert spent.steps == 4


def test_icp_stops_where_it_gains_no_more():
    x, _ = skin(500, moved(0.1))
    kinds = [Settings(quality=0.0, stop=stop, steps=(3, 30)) for stop in (1e9, 1e-6, None)]
    fits = [next(iter(voodoo([[PointCloud("s", 0.0, x)]], BODY, STATE, RIG, kind))) for kind in kinds]
    assert fits[0].steps == 3 < fits[1].steps < fits[2].steps == 30


def test_the_floor_is_left_out_by_its_plane():
    """Points below the feet would draw the shanks down; with their plane they count for nothing."""
    low = FRAMES[:, 10].min() - 0.45
    u, v = np.meshgrid(np.linspace(-0.3, 0.3, 40), np.linspace(-0.3, 0.3, 40))
    cloud = [PointCloud("s", 0.0, np.stack([u.ravel(), np.full(u.size, low), v.ravel()], axis=1))]
    nothing = [PointCloud("s", 0.0, np.zeros((0, 3)))]
    s = Settings(floor=(0.0, 1.0, 0.0, low), limb_box=0.3, bound=0.3, body_box=0.3)
    fits = [next(iter(voodoo([seen], BODY, STATE, RIG, settings))).frames
            for seen, settings in ((cloud, replace(s, floor=None)), (cloud, s), (nothing, s))]  # fmt: skip
    assert np.abs(fits[0] - fits[2]).max() > 0.02
    np.testing.assert_array_equal(fits[1], fits[2])


def test_the_nearest_surface_takes_a_point_of_several_boxes():
    x, segment = skin(600)
    member = steps.nearest_limb(BODY, FRAMES, x, 0.1)
    assert (member.sum(axis=1) == 1).all()
    assert member[np.arange(len(x)), segment].mean() > 0.9  # some lie within another limb's surface


def test_bands_in_proportion_to_points_weigh_as_much_as_those():
    bands, weight = joint_bands(BODY), np.full(90, 2.0)
    measured = steps.Pairs(np.zeros((90, 3)), np.zeros((90, 3)), weight, np.zeros(90, int))
    own, other = motion.band_weights(bands, measured, 0.5, 40)
    total = np.bincount(np.concatenate([bands.parent.segments, bands.child.segments]), np.concatenate([own, other]))
    np.testing.assert_allclose(total, np.where(np.arange(len(total)) == 0, 0.5 * 180.0, 0.5 * 40.0))
    assert set(np.concatenate(motion.band_weights(bands, measured, 30.0, None))) == {30.0}


def test_what_hangs_on_a_limb_goes_with_it():
    """Only the trunk is seen, turned: all limbs turn with it, and none of the bands is stretched."""
    turn = np.array(STATE.T_world_root)
    turn[:3, :3] = [[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]]
    x, segment = skin(3000, replace(STATE, T_world_root=turn))
    trunk = [PointCloud("s", 0.0, x[segment == 0], segment=BODY.tree.segments[0])]
    settings = Settings(quality=0.0, steps=(0, 40), maximum=400)
    down, apart = (next(iter(voodoo([trunk], BODY, STATE, RIG, s))).frames
                   for s in (settings, replace(settings, down=False)))  # fmt: skip
    angle = [np.arccos(np.clip((np.trace(f[:9].reshape(3, 3) @ g[:9].reshape(3, 3).T) - 1) / 2, -1, 1))
             for f, g in zip(down, FRAMES)]  # fmt: skip
    assert angle[0] > 0.05
    np.testing.assert_allclose(angle[1:], angle[0], atol=0.03)
    assert np.abs(down - apart).max() > 0.01


def test_nothing_seen_leaves_the_body_where_it_was():
    fit = next(iter(voodoo([[PointCloud("s", 0.0, np.zeros((0, 3)))]], BODY, STATE, RIG)))
    np.testing.assert_allclose(fit.frames, FRAMES, atol=2e-2)  # the neck's bands pull: it is bent in the usual pose
    assert np.isfinite(fit.frames).all() and len(joint_bands(BODY)) == 16


def test_angles_of_a_limb_are_those_it_was_turned_by():
    rng, tree = np.random.default_rng(3), BODY.tree
    for s in range(1, len(tree.segments)):
        own = slice(tree.dof_start[s], tree.dof_start[s + 1])
        angles = tree.usual[own] + 0.6 * rng.uniform(-1, 1, own.stop - own.start)
        R = np.eye(3)
        for axis, angle in zip(tree.axes[own], angles):
            R = R @ se3.exp_so3(axis * angle)
        np.testing.assert_allclose(motion.rotation_angles(tree.axes[own], R, tree.usual[own]), angles, atol=1e-6)


def bent_backwards(excess):
    """A state with the right knee and elbow beyond their ranges [rad]."""
    angles, tree = np.array(STATE.angles), BODY.tree
    for name in ("knee_angle_r", "elbow_flex_r"):
        k = tree.coordinate(name)
        angles[k] = tree.lower[k] - excess
    return replace(STATE, angles=angles)


def test_ranges_pair_limbs_that_are_beyond_them():
    assert not len(motion.range_pairs(BODY, FRAMES, 1.0).limb)
    beyond = bent_backwards(0.4)
    frames, _ = BODY.tree.forward(beyond.T_world_root, beyond.angles)
    pairs = motion.range_pairs(BODY, frames, 5.0)
    assert set(pairs.limb) == {BODY.tree.segment("shank_r"), BODY.tree.segment("forearm_r")}
    apart = np.linalg.norm(pairs.source - pairs.target, axis=1)  # chords at the lever; the axis itself does not move
    np.testing.assert_allclose(apart[apart > 1e-9], 2 * 0.1 * np.sin(0.2), rtol=1e-6)
    assert set(pairs.weight) == {5.0}


def test_ranges_bend_a_knee_back_that_points_pull_beyond():
    """Wrong points show the right shank bent forwards at the knee by 23 degrees."""
    beyond = bent_backwards(0.4)
    x, segment = skin(3000, beyond)
    shank, k = BODY.tree.segment("shank_r"), BODY.tree.coordinate("knee_angle_r")
    seen = [PointCloud("s", 0.0, x[segment == s], segment=BODY.tree.segments[s]) for s in np.unique(segment)]
    excess = []
    for weight in (0.0, 300.0, 3000.0):
        settings = Settings(ranges=weight, quality=0.0, steps=(0, 40))
        R = next(iter(voodoo([seen], BODY, STATE, RIG, settings))).frames[:, :9].reshape(-1, 3, 3)
        own, above = slice(k, k + 1), R[BODY.tree.parents[shank]]
        excess.append(BODY.tree.lower[k] - motion.rotation_angles(BODY.tree.axes[own], above.T @ R[shank], [0.0])[0])
    assert excess[0] > 0.3 > excess[1] > excess[2] and excess[2] < 0.1
