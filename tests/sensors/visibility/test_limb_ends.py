"""Joints that a picture shows, and those that lie beside it: drawn bodies, so that the truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.limbs import of_fingers
from kinefit.bodies.rendering import Canvas, render_body
from kinefit.geometry.camera import Camera
from kinefit.sensors.visibility.visibility import Layers, judge_segments

BODY = load_body("humanoid")
LENS = np.array([[275.0, 0, 159.5], [0, 275.0, 119.5], [0, 0, 1]])


def seen_from(middle, far=1.2):
    """A camera before a point (3,) of a body that stands along y and looks along x."""
    T = np.eye(4)
    T[:3, :3] = [[0, 0, -1], [0, -1, 0], [-1, 0, 0]]
    T[:3, 3] = -T[:3, :3] @ (np.asarray(middle) + (far, 0.0, 0.0))
    return Camera("depth", (320, 240), LENS, T_camera_world=T)


@pytest.fixture(scope="module")
def standing():
    """A body with its arms a little out, and where its joints are."""
    state = BODY.rest_state()
    delta = np.zeros(BODY.tree.n_dofs)
    for side in "rl":
        delta[6 + BODY.tree.coordinate(f"arm_add_{side}")] = -0.5
    state = state.retract(delta)
    frames, _ = BODY.tree.forward(state.T_world_root, state.angles)
    poses = BODY.tree.segment_poses(state.T_world_root[None], state.angles[None])[0]
    return state, frames, dict(zip(BODY.tree.segments, poses[:, :3, 3]))


def verdict_of(state, frames, camera, depth):
    layers = Layers(BODY, camera)
    return judge_segments(layers.mesh.posed(frames), layers, depth, camera)


def depth_of(state, camera):
    depth = render_body(BODY, state, camera).depth
    return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)


def test_an_elbow_above_the_picture_is_not_seen_however_well_the_forearm_agrees(standing):
    state, frames, joints = standing
    forearm = BODY.tree.segments.index("forearm_r")
    elbow, wrist = joints["forearm_r"], joints["hand_r"]
    half = 119.5 / 275.0 * 1.2  # [m] of the picture
    for above, hidden in ((0.06, True), (-0.1, False)):  # the picture's upper edge
        camera = seen_from((elbow[0], elbow[1] - above - half, wrist[2]))
        verdict = verdict_of(state, frames, camera, depth_of(state, camera))
        assert verdict.supported[forearm] > 100
        assert verdict.unseen[forearm] == hidden
        assert verdict.evidence.hidden[forearm] == hidden and not verdict.evidence.lost[forearm]


def test_all_joints_of_a_person_in_the_picture_are_seen(standing):
    state, frames, joints = standing
    camera = seen_from(joints["abdomen"], 2.8)
    verdict = verdict_of(state, frames, camera, depth_of(state, camera))
    assert not verdict.unseen.any()


def test_what_is_contradicted_stays_so_where_its_joint_is_unseen_too(standing):
    state, frames, joints = standing
    camera = seen_from(joints["abdomen"], 2.8)
    verdict = verdict_of(state, frames, camera, np.full((240, 320), 6.0, np.float32))
    forearm = BODY.tree.segments.index("forearm_r")
    assert verdict.unseen[forearm] and verdict.evidence.lost[forearm]


def test_a_fist_contradicts_no_hand(standing):
    """The same body without what lies beyond the knuckles: the hand counts by its palm."""
    _, frames, joints = standing
    hand = BODY.tree.segments.index("hand_r")
    camera = seen_from(joints["hand_r"])
    layers = Layers(BODY, camera)
    mesh = layers.mesh
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    palm = replace(mesh, faces=mesh.faces[~of_fingers(BODY, mesh.face_segment, middles)])
    x = mesh.posed(frames)
    drawn = Canvas(camera.size).draw_for(camera, x, palm.faces).depth
    depth = np.where(np.isfinite(drawn), drawn, 6.0).astype(np.float32)
    evidence = judge_segments(x, layers, depth, camera).evidence
    assert evidence.quality[hand] > 0.9 and not evidence.hidden[hand]
    depth[:] = 6.0  # no palm either
    assert judge_segments(x, layers, depth, camera).evidence.lost[hand]
