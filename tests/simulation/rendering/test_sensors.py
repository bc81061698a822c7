"""Simulated depth, stereo and colour against the truth that they were made from."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.simulation import (
    COLOUR,
    KINECT,
    STEREO,
    TOF,
    ColourSensor,
    DepthSensor,
    SimulatedScene,
    cut,
    in_front,
    known_motion,
    on_body,
    picture,
    simulate_depth,
    squat_and_wave,
)
from kinefit.simulation.figures import look_at
from kinefit.simulation.rendering.scenes import room


@pytest.fixture(scope="module")
def motion():
    return cut(squat_and_wave(), 20, 24)


def small(sensor, share=0.25):
    """The same sensor with fewer pixels."""
    w, h = sensor.size
    return replace(sensor, size=(int(share * w), int(share * h)), focal=share * sensor.focal)


def placed(motion, sensor, **where):
    return in_front(motion, sensor.camera(), near=sensor.near, far=sensor.far, **where)


@pytest.mark.parametrize("sensor", [TOF, small(KINECT)], ids=["tof", "kinect"])
def test_without_errors_every_point_of_the_body_lies_on_its_surface(motion, sensor):
    camera = placed(motion, sensor)
    frame = simulate_depth(motion, camera, sensor.without_errors(), room=False).frame(2)
    assert 0.03 < (frame.depth > 0).mean() < 0.5
    a, b = camera.ray_table
    seen = frame.depth > 0
    x = np.stack([a, b, np.ones_like(a)], axis=-1)[seen] * frame.depth[seen][:, None]
    x = (x - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]
    state = motion.state(2)
    frames, _ = motion.body.tree.forward(state.T_world_root, state.angles)
    gap = np.full(len(x), np.inf)
    for surface in motion.body.surfaces:  # round or elliptic: the distance to the axis, as a share of the radius there
        f = frames[surface.segment]
        local = (x - f[9:]) @ f[:9].reshape(3, 3) - motion.body.tree.rest[surface.segment] - surface.start
        p = local @ surface.axes.T
        t = np.clip(p[:, 2] / surface.length, 0, 1)[:, None]
        radii = (1 - t) * np.array(surface.radii[0]) + t * np.array(surface.radii[1])
        beside = np.abs(np.hypot(*(p[:, :2] / radii).T) - 1) * radii.min(axis=1)
        ends = np.minimum(np.abs(p[:, 2]), np.abs(p[:, 2] - surface.length))
        gap = np.minimum(gap, np.maximum(np.minimum(beside, ends), np.abs(p[:, 2] - t[:, 0] * surface.length)))
    assert np.quantile(gap, 0.99) < 0.003  # facets of 20 corners


@pytest.mark.parametrize("sensor", [TOF, replace(KINECT, disparity_step=0.0)], ids=["tof", "kinect"])
def test_noise_is_as_large_as_stated(motion, sensor):
    """On the wall, away from edges, seen almost straight on."""
    camera = placed(motion, sensor)
    scene = SimulatedScene.of(motion, camera)
    truth = simulate_depth(motion, camera, sensor.without_errors(), scene=scene).frame(0).depth
    view = scene.view(0, camera)
    wall = view.raster.segment == len(motion.body.tree.segments) + 1
    flat = cv2.erode((wall & (view.cosine > 0.95)).astype(np.uint8), np.ones((5, 5))) > 0
    error = simulate_depth(motion, camera, sensor, scene=scene, seed=4).frame(0).depth - truth
    ok = flat & (error > -truth)
    share = (error / sensor.sigma(truth))[ok]
    assert ok.sum() > 500
    assert share.std() == pytest.approx(1.0, abs=0.1)
    assert abs(share.mean()) < 0.1


def test_a_pixel_on_an_edge_tells_a_depth_between_both_surfaces(motion):
    camera = placed(motion, TOF)
    scene = SimulatedScene.of(motion, camera)
    quiet = replace(TOF.without_errors(), samples=3)
    truth = simulate_depth(motion, camera, TOF.without_errors(), scene=scene).frame(0).depth
    mixed = simulate_depth(motion, camera, quiet, scene=scene).frame(0).depth
    window = np.ones((3, 3))
    low, high = cv2.erode(truth, window), cv2.dilate(truth, window)
    flying = (mixed > low + 0.1) & (mixed < high - 0.1) & (high - low > 0.3)
    assert flying.sum() > 100
    inside = (mixed >= low - 0.02) & (mixed <= high + 0.02)
    assert inside.mean() > 0.995
    assert not ((truth > low + 0.1) & (truth < high - 0.1) & (high - low > 1.0)).sum() > 0.2 * flying.sum()


def test_the_projector_casts_a_shadow_on_one_side(motion):
    sensor = small(KINECT, 0.5)
    camera = placed(motion, sensor)
    scene, bare = SimulatedScene.of(motion, camera), sensor.without_errors()
    truth = simulate_depth(motion, camera, bare, scene=scene).frame(0).depth
    lit = simulate_depth(motion, camera, replace(bare, baseline=0.075), scene=scene).frame(0).depth
    right = (lit == 0) & (truth > 0)
    assert 0.003 < right.mean() < 0.1
    behind = truth[right]
    nearer = cv2.erode(np.where(truth > 0, truth, 9).astype(np.float32), np.ones((1, 41)))[right]
    assert (behind > nearer + 0.04).mean() > 0.99  # something nearer stands in the same row
    rows, columns = np.nonzero(right)
    beside = truth[rows, np.minimum(columns + 12, truth.shape[1] - 1)]
    assert np.median(behind - beside) > 0.3  # and on the right, where the projector is


def test_depths_come_in_steps_of_disparity(motion):
    sensor = replace(small(KINECT).without_errors(), baseline=0.075, disparity_step=0.125)
    depth = simulate_depth(motion, placed(motion, sensor), sensor).frame(0).depth
    steps = sensor.focal * sensor.baseline / sensor.disparity_step / depth[depth > 0]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)
    assert len(np.unique(np.round(steps))) > 5


@pytest.mark.parametrize("sensor", [TOF, small(KINECT)], ids=["tof", "kinect"])
def test_nothing_outside_the_range_is_measured_and_a_seed_is_a_seed(motion, sensor):
    sensor = replace(sensor, near=1.5, far=3.2)
    camera = in_front(motion, sensor.camera(), distance=2.5)
    video = simulate_depth(motion, camera, sensor, seed=3)
    first, second = video.frame(0).depth, video.frame(1).depth
    got = first[first > 0]
    assert got.min() >= 1.5
    assert got.max() <= 3.2
    assert 0.05 < (first == 0).mean() < 0.95
    again = simulate_depth(motion, camera, sensor, seed=3)
    np.testing.assert_array_equal(again.frame(1).depth, second)  # in whatever order
    np.testing.assert_array_equal(again.frame(0).depth, first)
    other = simulate_depth(motion, camera, sensor, seed=4).frame(0).depth
    assert (other != first)[(other > 0) & (first > 0)].mean() > 0.1  # fewer where disparities are rounded
    assert (second != first)[(second > 0) & (first > 0)].mean() > 0.1
    assert len(video) == len(motion)
    assert video.size == camera.size


def test_the_grain_sticks_to_the_surface_in_both_pictures_of_a_stereo_head(motion):
    left, right = STEREO.pair(in_front(motion, STEREO.camera(name="stereo_left")))
    scene, quiet = SimulatedScene.of(motion, left), replace(STEREO, noise=0.0)
    depth = scene.view(1, left).raster.depth
    pictures = [picture(scene, 1, c, quiet, grey=True).astype(np.float32) for c in (left, right)]
    u = np.arange(left.size[0], dtype=np.float32) - STEREO.focal * STEREO.baseline / depth
    v = np.repeat(np.arange(left.size[1], dtype=np.float32)[:, None], left.size[0], axis=1)
    warped = cv2.remap(pictures[1], u.astype(np.float32), v, cv2.INTER_LINEAR)
    other = scene.view(1, right).raster.depth
    there = (u > 2) & (np.abs(cv2.remap(other, u.astype(np.float32), v, cv2.INTER_NEAREST) - depth) < 0.02)
    error, contrast = np.abs(warped - pictures[0])[there], np.std(pictures[0][there])
    assert there.mean() > 0.5
    assert contrast > 15.0
    assert np.median(error) < 0.25 * contrast
    body = there & (scene.view(1, left).raster.segment < len(motion.body.tree.segments))
    assert np.median(np.abs(warped - pictures[0])[body]) < 0.25 * contrast


def test_the_grain_moves_with_the_body(motion):
    """A point of the body has one place at rest, whatever the frame and the camera."""
    scene = SimulatedScene.of(motion)
    for frame, azimuth in ((0, 0.0), (3, 1.0)):
        camera = in_front(motion, small(KINECT).camera(), azimuth=azimuth)
        view = scene.view(frame, camera)
        seen, state = view.raster.seen, motion.state(frame)
        frames, _ = motion.body.tree.forward(state.T_world_root, state.angles)
        f = frames[view.raster.segment[seen]]
        x = np.einsum("njk,nk->nj", f[:, :9].reshape(-1, 3, 3), view.x_rest[seen]) + f[:, 9:]
        v, u = np.nonzero(seen)
        np.testing.assert_allclose(camera.project(x), np.stack([u, v], axis=1), atol=1e-6)


def test_pictures_show_skin_and_clothes(motion):
    camera = in_front(motion, COLOUR.camera())
    scene = SimulatedScene.of(motion, camera)
    image = picture(scene, 0, camera, seed=1)
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    segment = scene.view(0, camera).raster.segment
    head = image[segment == motion.body.tree.segment("head")].mean(axis=0)
    thigh = image[segment == motion.body.tree.segment("thigh_r")].mean(axis=0)
    assert head[2] > head[1] > head[0]  # BGR: skin is red before green before blue
    assert thigh[0] > thigh[2]
    np.testing.assert_array_equal(image, picture(scene, 0, camera, seed=1))
    assert (image != picture(scene, 0, camera, seed=2)).mean() > 0.3


@pytest.mark.parametrize("up", sorted(UP_AXES))
@pytest.mark.parametrize("azimuth", [0.0, 2.0])
def test_the_room_is_closed_wherever_the_camera_looks_and_the_body_stands_in_it(motion, up, azimuth):
    turned = motion.turned(up)
    camera = placed(turned, small(TOF, 0.5), azimuth=azimuth)
    around = room(turned, camera)
    scene = SimulatedScene(turned, SimulatedScene.of(turned).mesh, around)
    raster = scene.view(0, camera).raster
    assert raster.seen.all()
    count = len(turned.body.tree.segments)
    assert {count, count + 1} <= set(np.unique(raster.segment))
    heights = around.vertices @ UP_AXES[up]
    body = np.concatenate([scene.mesh.posed(turned.body.tree.forward(s.T_world_root, s.angles)[0])
                           for s in map(turned.state, range(len(turned)))])  # fmt: skip
    floor, lowest = heights[np.unique(around.faces[around.parts == 0])], (body @ UP_AXES[up]).min()
    assert np.ptp(floor) < 1e-9
    assert lowest - 0.1 < floor[0] < lowest + 0.05
    side = camera.T_camera_world[0, :3]
    table = around.vertices[np.unique(around.faces[around.parts == 2])] @ side
    assert table.min() > (body @ side).max()


def test_a_sensor_stands_in_front_and_sees_all(motion):
    camera = placed(motion, KINECT)
    uv = camera.project(motion.positions().reshape(-1, 3))
    assert np.all((uv > 0) & (uv < KINECT.size))
    nose, neck = (motion.positions(motion.body.landmarks.select((name,)))[0, 0] for name in ("nose_tip", "cervicale"))
    depths = [camera.T_camera_world[2, :3] @ x for x in (nose, neck)]
    assert depths[0] < depths[1]  # the face is nearer than the nape
    shoulders = motion.body.landmarks.select(("l_acromion", "r_acromion"))
    left, right = camera.project(motion.positions(shoulders)[0])
    assert left[0] > right[0]  # face to face, their left is on our right
    from_left = placed(motion, KINECT, azimuth=np.pi / 2)
    ls, rs = motion.positions(shoulders)[0] @ from_left.T_camera_world[2, :3]
    assert ls < rs
    with pytest.raises(ObservationError, match="no place of kinect"):
        placed(motion, replace(KINECT, far=1.2))


def test_looking_down_still_has_a_room(motion):
    up = np.array(UP_AXES[motion.up])
    middle = motion.positions().reshape(-1, 3).mean(axis=0)
    T = look_at(middle + 2.4 * up + 1e-9, middle, np.roll(up, 1))
    camera = Camera("top", (40, 30), np.array([[30.0, 0, 19.5], [0, 30, 14.5], [0, 0, 1]]), (), "radtan", T)
    assert SimulatedScene.of(motion, camera).view(0, camera).raster.seen.all()


def test_another_body_does_the_same(motion):
    slight = on_body(motion, load_body("humanoid10"))
    names = ("r_shoulder", "l_shoulder", "r_elbow", "l_elbow", "r_knee", "l_knee", "r_wrist", "l_wrist")
    both = [m.positions(m.body.landmarks.select(names)) for m in (motion, slight)]
    assert np.linalg.norm(both[0] - both[1], axis=-1).max() < 0.06
    assert slight.rate == motion.rate
    assert slight.up == motion.up
    limits = slight.body.tree
    assert np.all((slight.angles >= limits.lower - 0.1) & (slight.angles <= limits.upper + 0.1))


def test_a_body_that_shares_nothing_is_refused(motion):
    body = motion.body
    bare = replace(body, landmarks=body.landmarks.select(body.landmarks.names[:3]))
    with pytest.raises(BodyError, match="in common"):
        on_body(motion, bare)


def test_a_body_without_surfaces_cannot_be_seen(motion):
    bare = known_motion(replace(motion.body, surfaces=()), 30.0, motion.Ts_world_root, motion.angles, up=motion.up)
    with pytest.raises(BodyError, match="surface"):
        SimulatedScene.of(bare)


def test_a_body_without_landmarks_is_placed_by_its_joints(motion):
    names = motion.body.landmarks.names[:0]
    body = replace(motion.body, landmarks=motion.body.landmarks.select(names))
    bare = known_motion(body, motion.rate, motion.Ts_world_root, motion.angles, up=motion.up)
    camera = placed(bare, TOF)
    assert SimulatedScene.of(bare, camera).view(0, camera).raster.seen.all()


@pytest.mark.parametrize("change", [{"near": 0.0}, {"far": 0.1}, {"samples": 0}, {"noise": (-0.1, 0.0, 0.0)}])
def test_a_sensor_that_cannot_be_is_refused(change):
    with pytest.raises(ObservationError, match="sensor"):
        DepthSensor(**{"name": "a", "size": (8, 8), "focal": 9.0, "near": 0.5, "far": 5.0, "noise": (0, 0, 0)} | change)


def test_a_colour_camera_that_cannot_be_is_refused():
    with pytest.raises(ObservationError, match="camera"):
        ColourSensor("a", (8, 8), 9.0, samples=0)


def test_a_turned_world_changes_nothing(motion):
    """The same pixels, wherever the world's origin is and however it is turned."""
    sensor = small(TOF, 0.5)
    T = se3.exp(np.array([0.4, -1.0, 2.0, 0.3, -0.8, 0.5]))
    camera = placed(motion, sensor)
    moved = known_motion(motion.body, motion.rate, T @ motion.Ts_world_root, motion.angles, up=motion.up)
    there = camera.with_pose(camera.T_camera_world @ np.linalg.inv(T))
    one = simulate_depth(motion, camera, sensor, room=False).frame(1).depth
    two = simulate_depth(moved, there, sensor, room=False).frame(1).depth
    assert ((one > 0) == (two > 0)).mean() > 0.999
    both = (one > 0) & (two > 0)
    assert np.quantile(np.abs(one - two)[both], 0.99) < 1e-4
