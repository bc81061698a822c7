"""Bodies that change with their pose, in the tracker: every sensor sees joints where they have moved to."""

from dataclasses import replace

import numpy as np
import pytest
from tests.sensors.scenes import at, ring

from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.rendering import Canvas
from kinefit.fitting.subject.fit import MatchedFrames, Worlds
from kinefit.fitting.subject.parameters import World
from kinefit.fitting.subject.surfaces import CylinderShape
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame, SilhouetteFrame
from kinefit.sensors.points.keypoints import KeypointSensor
from kinefit.sensors.points.markers import MarkerSensor
from kinefit.sensors.regions.silhouette import SilhouetteSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.bundle.border_frames import differences
from kinefit.solving.correspondences.contours.outlines import on_moved_joints
from kinefit.solving.rows import DofRows

JOINTS = ("arm_flex_r", "arm_add_r", "arm_flex_l", "elbow_flex_r")


@pytest.fixture(scope="module")
def body():
    return load_body("humanoid_morphing")


@pytest.fixture(scope="module")
def rig():
    return ring(3)


def posture(body, i):
    return at(body, arm_flex_r=70 + 2 * i, arm_add_r=-35 - i, elbow_flex_r=50 + i, arm_flex_l=40 + 2 * i)


def silhouettes(model, state, rig, time):
    """Masks of a body as it is morphed."""
    vertices, out = model.pose(state).vertices, []
    for camera in rig:
        seen = Canvas(camera.size).draw_for(camera, vertices, model.mesh.faces, cull=True).seen
        out.append(SilhouetteFrame(camera.name, time, seen.copy()))
    return out


def markers(model, state, time, names=None):
    points = model.body.landmarks if names is None else model.body.landmarks.select(names)
    return MarkerFrame("markers", time, points.names, model.pose(state).positions(points))


def off(body, found, truth):
    """(4,) [deg] errors of arm angles."""
    own = [body.tree.coordinate(name) for name in JOINTS]
    return np.degrees(np.abs(found.angles - truth.angles))[own]


def depth(model, state, rig, time):
    """Depth images of a body as it is morphed, before nothing."""
    vertices, out = model.pose(state).vertices, []
    for camera in rig:
        image = Canvas(camera.size).draw_for(camera, vertices, model.mesh.faces, cull=True).depth
        out.append(DepthFrame(camera.name, time, np.where(np.isfinite(image), image, 0.0)))
    return out


LIMITS = {"silhouettes": 1.5, "markers": 0.3, "both": 0.3, "depth": 1.5}  # [deg]


@pytest.mark.parametrize("sensors", LIMITS)
def test_arms_are_followed_with_their_shoulders(body, rig, sensors):
    """The morphing body finds the arms' angles; the same one held stiff is off."""
    model, ends = Morphing(body), {}
    for name, own in (("morphing", body), ("stiff", replace(body, morphs=()))):
        follow = Tracker(own, rig, rate=30.0, settings=TrackSettings(search=False), up="y")
        follow.start_at(posture(body, 0))
        for i in range(8):
            truth, frames = posture(body, i), []
            if sensors in ("silhouettes", "both"):
                frames += silhouettes(model, truth, rig, i / 30)
            if sensors in ("markers", "both"):
                frames.append(markers(model, truth, i / 30))
            if sensors == "depth":
                frames += depth(model, truth, rig, i / 30)
            result = follow.update(frames)
        ends[name] = off(body, result.state, truth).mean()
    assert ends["morphing"] < LIMITS[sensors]
    assert ends["stiff"] > 2 * ends["morphing"]


def test_error_bars_have_the_error_of_each_surface(body, rig):
    """By silhouettes alone a body that morphs is about as uncertain as the same one held stiff."""
    bars, start = [], posture(body, 0)
    for own in (body, replace(body, morphs=())):
        follow = Tracker(own, rig, rate=30.0, settings=TrackSettings(search=False), up="y")
        follow.start_at(start)
        result = follow.update(silhouettes(Morphing(own), start, rig, 0.0))
        bars.append(result.dof_std[6:][[own.tree.coordinate(name) for name in JOINTS]])
    assert (np.degrees(bars) > 2.0).all()
    ratio = bars[0] / bars[1]
    assert (ratio > 0.4).all() and (ratio < 2.5).all(), ratio


def keypoint_sensor(rig):
    return KeypointSensor(rig, {}, 3.0, geman_mcclure(), 0.03)


def marker_sensor():
    return MarkerSensor("markers", 0.01, geman_mcclure(), 0.03)


def test_keypoints_and_markers_make_rows_on_moved_joints(body, rig):
    model, state = Morphing(body), posture(body, 3)
    keypoints = body.keypoints("COCO_17")
    x = model.pose(state).positions(keypoints)
    uv = rig.cameras[1].project(x)
    frame = KeypointFrame("c1", 0.0, keypoints.names, uv, np.ones(len(uv)), "COCO_17")
    here = Scene(body, state, rig)
    for measurement in (
        keypoint_sensor(rig).prepare([frame], here), marker_sensor().prepare(markers(model, state, 0.0), here)
    ):  # fmt: skip
        match = measurement.match(here, 0.1)
        np.testing.assert_allclose(match.squares(here), 0.0, atol=1e-12)
        (rows,) = match.rows(here)
        assert isinstance(rows, DofRows)
        np.testing.assert_allclose(rows.residual, 0.0, atol=1e-9)
        step, h = np.random.default_rng(0).normal(size=body.tree.n_dofs), 1e-6
        ends = [match.rows(here.at(state.retract(s * h * step)))[0] for s in (-1, 1)]
        slope = (ends[1].residual - ends[0].residual) / (2 * h)
        np.testing.assert_allclose(rows.jacobian @ step, -slope, atol=1e-5)


def test_without_moving_joints_the_derivative_is_the_trees(body, rig):
    plain, state = replace(body, morphs=()), posture(body, 3)
    model, here = Morphing(plain), Scene(plain, state, rig)
    (rows,) = marker_sensor().prepare(markers(model, state, 0.0), here).match(here, 0.1).rows(here)
    J = on_moved_joints(model.pose(state), rows).jacobian
    assert not model.moves_joints and model.is_rigid
    _, screws = plain.tree.forward(state.T_world_root, state.angles)
    arm = rows.point - state.T_world_root[:3, 3]
    for k in range(0, len(rows), 17):
        a = np.r_[rows.direction[k], np.cross(arm[k], rows.direction[k])]
        np.testing.assert_allclose(J[k], a @ plain.tree.segment_jacobian(screws, int(rows.segment[k])), atol=1e-12)


def test_half_axes_of_different_segments_are_derived_together(rig):
    """Bulges of one segment do not depend on another segment's cylinders: a fit needs few worlds for all of them."""
    body = load_body("humanoid_shoulders")
    state, shape = at(body, clav_elev_r=15, clav_prot_l=10, arm_flex_r=40), CylinderShape(body)
    scene = Scene(body, state, rig)
    masks = silhouettes(Morphing(body), state, rig, 0.0)
    seen = [SilhouetteSensor(rig[m.sensor], 1.0, TrackSettings()).prepare(m, scene) for m in masks]
    frames = MatchedFrames(Worlds(World(body, rig), [shape]), [seen], None, None, shape.mean, [state], 0.05)
    worlds = []

    class Counted:
        touches = frames.touches
        body = frames.body

        def parts(self, theta, frame, state):
            worlds.append(theta)
            return frames.parts(theta, frame, state)

    class Apart(Counted):
        touches = (None,) * len(shape.names)

    together = differences(Counted(), shape.mean, shape.step, [state])[0]
    few = len(worlds)
    apart = differences(Apart(), shape.mean, shape.step, [state])[0]
    np.testing.assert_allclose(together, apart, atol=1e-9)
    assert few < 0.3 * (len(worlds) - few) and np.abs(together).max() > 1.0
    (rows,) = frames.parts(shape.mean, 0, state)[0][1:]
    assert isinstance(rows, DofRows) and rows.jacobian.shape == (len(rows), body.tree.n_dofs)
