"""Who is in a depth image: the floor and the empty scene go, two people are two."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import ObservationError, TrackingError
from kinefit.fitting.initialization.from_depth import start_from_points
from kinefit.geometry.camera import Camera
from kinefit.images.depth import clean, denoised, to_points
from kinefit.images.depth_scene import background_model, clusters, find_floor, foreground, people
from kinefit.readers.depth.recordings import read_depth
from kinefit.simulation.figures import in_front
from kinefit.simulation.movements import movement
from kinefit.simulation.rendering.scenes import SimulatedScene
from kinefit.simulation.rendering.sensors import KINECT, TOF, measured_depth

CAMERA = Camera("kinect", (320, 240), [[287.5, 0, 159.5], [0, 287.5, 119.5], [0, 0, 1]])
UP = (0.0, -1.0, 0.0)


def scene(*, floor=None, wall=None, bodies=(), noise=0.0, seed=0):
    """Depth image of a level floor below the sensor, a wall, and upright ellipsoids (x, y, z, half height)."""
    a, b = CAMERA.ray_table
    depth = np.full(a.shape, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        if floor is not None:
            depth = np.minimum(depth, np.where(b > 0, floor / b, np.inf))
        if wall is not None:
            depth = np.minimum(depth, wall)
        for x, y, z, h in bodies:
            scale = np.array([0.22, h, 0.13])
            d, o = np.stack([a, b, np.ones_like(a)]) / scale[:, None, None], -np.array([x, y, z]) / scale
            aa, bb, cc = (d * d).sum(0), (d * o[:, None, None]).sum(0), (o * o).sum() - 1
            depth = np.minimum(depth, np.where(bb * bb > aa * cc, (-bb - np.sqrt(bb * bb - aa * cc)) / aa, np.inf))
    depth = np.where(np.isfinite(depth) & (depth < 8), depth, 0.0)
    return (depth + (depth > 0) * noise * np.random.default_rng(seed).normal(size=depth.shape)).astype(np.float32)


def test_a_floor_is_found_under_a_person_before_a_wall():
    depth = scene(floor=1.1, wall=4.0, bodies=[(0.1, 0.25, 2.5, 0.85)], noise=0.005)
    floor = find_floor(to_points(depth, CAMERA, step=3), UP)
    np.testing.assert_allclose(floor.normal, UP, atol=0.01)
    assert floor.above(np.array([[0.0, 1.1, 3.0], [0.0, 0.0, 3.0]])) == pytest.approx([0.0, 1.1], abs=0.01)


def test_a_tilted_sensor_and_a_wall_alone():
    depth = scene(floor=1.1, wall=4.0, noise=0.005)
    x = to_points(depth, CAMERA, step=3)
    up = np.array([0.0, -np.cos(0.2), np.sin(0.2)])  # one believes it to be held 11 degrees otherwise
    np.testing.assert_allclose(find_floor(x, up).normal, UP, atol=0.01)
    assert find_floor(to_points(scene(wall=3.0, noise=0.005), CAMERA, step=3), UP) is None
    assert find_floor(x[:50], UP) is None


def test_a_floor_that_fills_a_tenth_of_the_image_is_found_whatever_is_drawn():
    depth = scene(floor=1.35, wall=4.2, noise=0.01)
    x = to_points(depth, CAMERA, step=3)
    assert 0.05 < np.mean(x[:, 1] > 1.3) < 0.13
    for seed in range(5):
        floor = find_floor(x, UP, seed=seed)
        np.testing.assert_allclose(floor.normal, UP, atol=0.03)


def test_a_body_has_no_floor_in_it(data_dir):
    cam = Camera("sr305", (640, 480), [[476.007, 0, 313.683], [0, 476.007, 242.755], [0, 0, 1]])
    video = read_depth(data_dir("depth_sr305_upperbody") / "20210326-231615", unit=0.000125)
    for i in (0, 5, 10):
        assert find_floor(to_points(video.frame(i).depth, cam, step=4), UP) is None


def test_people_are_told_apart_and_the_room_is_left_out():
    bodies = [(-0.5, 0.25, 2.9, 0.85), (0.5, 0.25, 3.2, 0.85)]
    depth = clean(scene(floor=1.1, wall=4.0, bodies=bodies, noise=0.003), CAMERA)
    floor = find_floor(to_points(depth, CAMERA, step=3), UP)
    found = sorted(people(depth, CAMERA, floor=floor), key=lambda blob: blob.centre[0])
    assert len(found) == 2 and not any(blob.cut for blob in found)
    for blob, (x, y, z, h) in zip(found, bodies):
        np.testing.assert_allclose(blob.centre, (x, y, z - 0.1), atol=0.08)
        assert blob.extent == pytest.approx(2 * h - 0.1, abs=0.05)  # soles and tips are left out
        assert blob.area == pytest.approx(np.pi * 0.22 * h, rel=0.15)
        assert (np.abs(depth[blob.mask] - z) < 0.25).all()


def test_the_empty_scene_takes_everything_else_away():
    empty = [scene(floor=1.1, wall=3.0, noise=0.01, seed=s) for s in range(9)]
    model = background_model(empty, share=0.5)
    assert np.abs(model - scene(floor=1.1, wall=3.0))[model > 0].max() < 0.03
    depth = scene(floor=1.1, wall=3.0, bodies=[(0.1, 0.25, 2.5, 0.85)], noise=0.01, seed=77)
    (blob,) = people(depth, CAMERA, mask=foreground(depth, model))
    truth = scene(bodies=[(0.1, 0.25, 2.5, 0.85)]) > 0
    assert (blob.mask & truth).sum() / (blob.mask | truth).sum() > 0.9


def test_the_empty_scene_is_learnt_while_a_person_walks_through():
    walk = [scene(floor=1.1, wall=3.0, bodies=[(x, 0.25, 2.2, 0.85)], noise=0.01, seed=k)
            for k, x in enumerate(np.linspace(-1, 1, 12))]  # fmt: skip
    walk[3][:20] = 0  # nothing measured there once
    model = background_model(walk)
    truth = scene(floor=1.1, wall=3.0)
    assert (np.abs(model - truth) < 0.05).mean() > 0.99


def test_background_of_nothing_and_of_two_sizes():
    unknown = background_model([np.zeros((4, 5))])
    np.testing.assert_array_equal(unknown, np.zeros((4, 5)))
    assert foreground(np.ones((4, 5)), unknown).all()
    with pytest.raises(ObservationError, match="shapes"):
        background_model([np.zeros((4, 5)), np.zeros((5, 4))])
    with pytest.raises(ObservationError, match="background"):
        foreground(np.zeros((4, 5)), np.zeros((5, 4)))


def test_clusters_join_what_is_near_and_part_what_is_far():
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 2, (300, 3))
    label, gap = clusters(x, 0.12), 0.12
    distance = np.linalg.norm(x[:, None] - x[None], axis=2)
    same = label[:, None] == label[None]
    assert same[distance < gap].all()
    reach = distance <= 2 * np.sqrt(3) * gap  # what is connected by such steps may be one, nothing else
    for _ in range(9):
        reach = (reach.astype(int) @ reach) > 0
    assert not (same & ~reach).any()
    assert len(clusters(np.zeros((0, 3)))) == 0


@pytest.mark.parametrize("name", ["wave", "sit_down", "shake_hands"])
@pytest.mark.parametrize("sensor", [TOF, KINECT], ids=lambda sensor: sensor.name)
def test_a_person_in_a_room_is_found_whatever_the_sensors_noise(name, sensor):
    motion = movement(name, rate=1.0)
    camera = in_front(motion, sensor.camera(), near=sensor.near, far=sensor.far)
    room = SimulatedScene.of(motion, camera)
    for frame in (0, 2):
        depth = measured_depth(room, frame, camera, sensor, np.random.default_rng(frame))
        clear = denoised(depth, camera)
        floor = find_floor(to_points(clear, camera, step=camera.size[0] // 160), (0.0, 1.0, 0.0))
        np.testing.assert_allclose(floor.normal, (0.0, 1.0, 0.0), atol=0.03)
        truth = np.isin(room.view(frame, camera).raster.segment, range(len(motion.body.tree.segments))) & (depth > 0)
        found = people(clear, camera, floor=floor, gap=0.075)
        overlap = [(blob.mask & truth).sum() / (blob.mask | truth).sum() for blob in found]
        assert len(found) <= 3 and max(overlap) > 0.85


def test_nothing_in_view_is_nobody():
    assert people(np.zeros((240, 320)), CAMERA) == ()


def test_a_real_person_in_a_real_room(data_dir):
    video = read_depth(data_dir("depth_pcl_person") / "person.pcd")
    depth = clean(video.frame(0).depth, video.camera)
    (blob,) = people(depth, video.camera)  # the wall, the door and a chair are none
    assert 0.6 < np.median(depth[blob.mask]) < 1.0 and (depth[blob.mask] < 1.3).all()
    assert blob.mask[200:480, 200:300].mean() > 0.9 and blob.cut


def test_real_people_are_counted(data_dir):
    cam = Camera("kinect", (640, 480), [[575, 0, 319.5], [0, 575, 239.5], [0, 0, 1]])
    video = read_depth(data_dir("depth_skeltrack_kinect1"), size=(640, 480))
    counts = [len(people(clean(video.frame(i).depth, cam, far=6.0), cam)) for i in range(len(video))]
    assert sorted(counts) == [1] * 10 + [2] * 2


@pytest.mark.parametrize("far", [6.0, 20.0, 49.0, 400.0])
def test_an_image_that_is_far_away_all_over_shows_nobody_at_little_cost(far):
    camera = KINECT.camera(name="kinect")
    noisy = far * (1.0 + 0.02 * np.random.default_rng(0).normal(size=(480, 640)))
    for depth in (np.full((480, 640), far), noisy):
        found = people(depth, camera)
        assert len(found) <= 40  # each holds an image's mask
        assert all(blob.mask.sum() >= 150 for blob in found)
    with pytest.raises(TrackingError, match="nothing in the depth image"):
        start_from_points(load_body("humanoid10"), None, camera, np.full((480, 640), far))
