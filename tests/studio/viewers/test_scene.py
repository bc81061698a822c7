"""What a scene shows, as arrays, against the motion and the cameras it is made of."""

import numpy as np
import pytest
from tests.exporters.synthetic import a_camera, smooth_motion

from kinefit.bodies import load_body
from kinefit.bodies.motion import OUTLIER_WEIGHT, nearest_frame
from kinefit.bodies.rendering import looks
from kinefit.geometry import se3
from kinefit.studio.viewers import player, scene


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(20)


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c))) / 6


@pytest.mark.parametrize("end", [(0, 0, 0.4), (0.1, -0.5, 0.2), (0, 0, 0)])
def test_a_capsule_is_closed_and_faces_outwards(end):
    mesh = scene.capsule(np.array([0.3, 0.2, 0.1]), np.array([0.3, 0.2, 0.1]) + end, (0.05, 0.05))
    length = np.linalg.norm(end)
    exact = np.pi * 0.05**2 * (length + 4 / 3 * 0.05)
    assert 0.85 * exact < volume(mesh) < exact  # inscribed, and positive: counterclockwise from outside
    assert np.allclose(mesh.vertices.min(0), np.minimum(0, end) + (0.3, 0.2, 0.1) - 0.05, atol=0.01)


def test_bones_reach_from_joint_to_joint(motion):
    body, Ts = motion.body, motion.segment_poses()[7]
    for child, parent in enumerate(body.tree.parents):
        if parent >= 0 and np.linalg.norm(body.tree.offsets[child]) > 1e-3:
            bone = se3.apply(Ts[parent], scene.bone_meshes(body)[0][parent].vertices)
            for joint in (Ts[child, :3, 3], Ts[parent, :3, 3]):
                assert np.linalg.norm(bone - joint, axis=1).min() < 0.015


def test_balls_at_joints_are_thinner_than_fingers():
    body = load_body("humanoid_hands")
    radii = dict(zip(body.tree.segments, scene.joint_radii(body)))
    assert radii["index_distal_l"] < 0.006 and radii["thumb_proximal_r"] < 0.0105
    assert radii["shank_l"] == radii["upperarm_r"] == radii["hand_l"] == 0.016


def test_every_surface_is_there():
    body = load_body("humanoid")
    meshes = scene.surface_meshes(body)
    assert {s for s, mesh in enumerate(meshes) if mesh} == {c.segment for c in body.surfaces}
    thigh = next(c for c in body.surfaces if body.tree.segments[c.segment] == "thigh_l")
    reach = np.linalg.norm(thigh.end) + sum(thigh.mean_radii)
    assert np.ptp(meshes[thigh.segment].vertices, axis=0).max() == pytest.approx(reach, rel=0.05)


def test_the_colours_of_quality_go_from_blue_to_vermillion():
    ramp = looks.quality_ramp(np.array([-1, 0.0, 0.5, 1.0, 9.0])).astype(int)
    assert np.array_equal(ramp[0], ramp[1]) and np.array_equal(ramp[3], ramp[4])
    assert ramp[1, 2] > ramp[1, 0] and ramp[3, 0] > ramp[3, 2]
    assert np.all(np.diff(looks.quality_ramp(np.linspace(0, 1, 9))[:, 2].astype(int)[:5]) <= 0)


def test_ellipsoids_are_two_sigmas_and_end_somewhere():
    body = load_body("humanoid_hands")
    std = np.full((len(body.tree.segments), 3), 0.01)
    names = ["pelvis", "shank_l", "index_proximal_l", "index_distal_l", "thumb_distal_r"]
    pelvis, shank, index, tip, thumb = (body.tree.segment(name) for name in names)
    std[pelvis], std[shank], std[thumb, 2] = [0.01, 0.02, np.inf], [np.nan, 3.0, 0.0], 0.02
    std[index : tip + 1] = np.inf
    axes = scene.ellipsoids(body, std)
    most = scene.LARGEST_ELLIPSOID
    assert np.allclose(axes[[pelvis, shank, thumb]], [[0.02, 0.04, most], [most, most, 0], [0.02, 0.02, 0.04]])
    finger = 2 * np.linalg.norm(body.tree.offsets[index : tip + 1], axis=1)  # one joint turns about the one above
    assert np.allclose(axes[index : tip + 1].T, 0.02 + np.cumsum(finger))


def test_rays_pass_through_what_was_measured_and_end_at_what_was_fitted(motion):
    camera, residuals, f = a_camera("cam 1", 0.7), motion.residuals["cam 1"], 5
    weights = residuals.weights[f].copy()
    weights[3:6] = 0.01
    points = scene.fitted_points(motion.body, residuals)
    x = motion.body.positions(motion.state(f), points)
    rays = scene.camera_rays(camera, residuals.measured[f], x, residuals.norms[f], weights, middling=3.0)
    seen = np.flatnonzero(np.isfinite(residuals.norms[f]))
    assert 0 < len(seen) < len(points) and rays.points.shape == (2 * len(seen), 2, 3) == rays.colours.shape
    ways, rests = rays.points[: len(seen)], rays.points[len(seen) :]
    assert np.allclose(ways[:, 0], camera.centre_world)
    assert np.allclose(camera.project(ways[:, 1]), residuals.measured[f, seen], atol=1e-6)
    assert np.allclose(rests[:, 0], ways[:, 1]) and np.allclose(rests[:, 1], x[seen])
    assert np.allclose(np.sum((rests[:, 1] - rests[:, 0]) * (ways[:, 1] - ways[:, 0]), axis=1), 0, atol=1e-9)
    left_out = weights[seen] < OUTLIER_WEIGHT
    red = np.all(rays.colours[: len(seen), 0] == scene.OUTLIER, axis=-1)
    assert left_out.any() and np.array_equal(red, left_out)


def test_points_are_those_that_the_residuals_are_of(motion):
    points = scene.fitted_points(motion.body, motion.residuals["cam 0"])
    fitted = motion.residuals["cam 0"].measured - motion.residuals["cam 0"].values
    uv = a_camera("cam 0", 0.0).project(motion.positions(points))
    assert np.nanmax(np.abs(uv - fitted)) < 1e-9
    assert scene.fitted_points(motion.body, motion.residuals["markers/1"]).names == motion.residuals["markers/1"].names
    assert scene.fitted_points(load_body("arm"), motion.residuals["cam 0"]) is None


@pytest.mark.parametrize(
    ("lowest", "up", "height"), [(0.3, "z", 0), (-0.2, "z", 0), (2.0, "z", 2.0), (-0.9, "z", -0.9), (1.0, "-z", -3.0)]
)
def test_the_floor_is_the_worlds_unless_it_is_far(lowest, up, height):
    points = np.array([[0, 0, lowest], [1, 1, lowest + 2.0], [0, 0, np.nan]])
    assert scene.floor_height(points, up) == pytest.approx(height)


def test_cameras_look_at_a_point():
    target, cameras = np.array([0.3, 0.95, 0.0]), [a_camera("c", turn) for turn in (0.0, 0.9, 2.5)]
    assert np.allclose(scene.looked_at(cameras), target, atol=1e-9)
    ahead = scene.looked_at(cameras[:1]) - cameras[0].centre_world
    assert np.allclose(ahead, 2 * cameras[0].T_camera_world[2, :3])


def test_no_points_have_a_floor():
    assert scene.floor_height(np.zeros((0, 3)), "y") == 0


def test_an_angle_is_told_with_two_sigmas(motion):
    name = motion.body.tree.coordinates[0]
    value, std = np.degrees(motion.angles[0, 0]), np.degrees(motion.dof_std[0, 6])
    assert scene.angle_line(motion, name, 0) == f"{name} {value:.1f}° ± {2 * std:.1f}°"
    assert scene.angle_line(motion, name, 3).endswith("(not observed)")


def test_a_course_has_its_band_and_where_it_is_unknown_the_band_fills_all(motion):
    name = motion.body.tree.coordinates[0]
    times, value, above, below, now = player.course(motion, name, 2)
    assert np.array_equal(times, motion.times) and np.allclose(value, np.degrees(motion.angles[:, 0]))
    assert np.flatnonzero(np.isfinite(now)).tolist() == [2] and now[2] == value[2]
    assert np.allclose((above - value)[:3], np.degrees(2 * motion.dof_std[:3, 6]))
    low, high = player.course_range(motion, name)
    assert below[3] < low < value.min() and value.max() < high < above[3]
    assert all(np.isfinite(a).all() for a in (value, above, below))


def test_a_frame_is_told(motion):
    text = player.summary(motion, 4)
    norms = motion.residuals["cam 0"].norms[4]
    assert f"cam 0: {np.nanmedian(norms):.1f} px" in text and f"{motion.quality[4]:.2f}" in text
    lost = np.flatnonzero(motion.segment_quality[4] <= 0)
    assert all(motion.body.tree.segments[s] in text for s in lost)


def test_the_clock_runs_in_a_loop():
    clock = player.PlaybackClock(count=10, rate=50.0, speed=0.5)
    clock.tick(1.0)
    assert clock.frame == 0  # it does not play yet
    clock.playing = True
    clock.tick(0.1)
    assert clock.frame == 2
    clock.tick(0.4)
    assert clock.frame == 2
    clock.step(-3)
    assert clock.frame == 9 and not clock.playing
    clock.go(99)
    assert clock.frame == 9
    clock.go(-5)
    assert clock.frame == 0


def test_the_nearest_frame_is_within_one():
    times = np.arange(5) / 10 + 2
    assert [nearest_frame(times, t, 10.0) for t in (1.95, 2.04, 2.06, 2.45, 2.6, 0.0)] == [0, 0, 1, 4, None, None]
    assert nearest_frame(np.zeros(0), 0.0, 10.0) is None


def test_names_are_text_in_markdown():
    assert scene.as_markdown("knee_angle_r é") == "knee_angle_r é"
    assert scene.as_markdown("<b>[x](y)") == "\\<b\\>\\[x\\]\\(y\\)"
