"""What the moving figure of a page holds: poses, skin, and which segments are lost or uncertain."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.bodies.motion import rotation_between_up
from kinefit.bodies.rendering.looks import body_mesh, side_colour, to_hex
from kinefit.exporters.report.figure import MAX_FIGURE_FRAMES, figure, live_figure
from kinefit.geometry import se3


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(20, rate=15.0, up="y")


def content(html):
    return json.loads(re.search(r'<script type="application/json">(.*)</script>', html, re.S)[1])


def unpacked(text, kind, width):
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, width)


def poses(data):
    """(F, S, 4, 4) as `player.js` reads them."""
    packed = unpacked(data["poses"], "<i2", 6).reshape(data["frames"], -1, 6).astype(float)
    v = packed[..., 3:] / 32767
    w = np.sqrt(np.maximum(1.0 - np.sum(v**2, axis=-1, keepdims=True), 0.0))
    R = se3.rotation_from_quaternion(np.concatenate([w, v], axis=-1).reshape(-1, 4)).reshape(*v.shape, 3)
    return se3.transform(R, np.array(data["middle"]) + data["quantum"] * packed[..., :3])


def test_poses_are_those_of_the_motion_turned_upright(motion):
    data = content(figure(motion))
    expected = se3.transform(rotation_between_up("y", "z"), np.zeros(3)) @ motion.segment_poses()
    assert data["frames"] == len(motion) and np.abs(poses(data) - expected).max() < 0.01
    assert np.abs(poses(data)[..., :3, 3] - expected[..., :3, 3]).max() < 1e-3


def test_the_skin_is_the_one_of_viewer_and_files(motion):
    data, mesh, tree = content(figure(motion)), body_mesh(motion.body), motion.body.tree
    skin = data["skin"]
    x = skin["grain"] * unpacked(skin["vertices"], "<i2", 3)
    faces = unpacked(skin["faces"], "<u2", 3)
    assert len(faces) == len(mesh.triangles) and np.allclose(x[faces], mesh.vertices[mesh.triangles], atol=1e-4)
    assert np.allclose(np.linalg.norm(unpacked(skin["normals"], "i1", 3) / 127.0, axis=1), 1.0, atol=0.02)
    weights, owners = unpacked(skin["weights"], "u1", 4) / 255.0, unpacked(skin["owners"], "u1", 4)
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 0.01
    shown = unpacked(skin["shown"], "u1", 1)[:, 0]
    assert np.array_equal(shown[faces[:, 0]], shown[faces[:, 2]]) and set(shown) == set(range(len(tree.segments)))
    assert np.mean(np.take_along_axis(owners, weights.argmax(axis=1)[:, None], axis=1)[:, 0] == shown) > 0.9
    assert data["colours"] == [to_hex(side_colour(name)) for name in tree.segments]
    assert np.allclose(data["rest"], tree.rest, atol=1e-5)


def test_lost_and_uncertain_segments_are_marked_frame_by_frame(motion):
    quality, std = np.ones_like(motion.segment_quality), np.full_like(motion.joint_std, 0.01)
    lost, unsure = motion.body.tree.segment("shank_l"), motion.body.tree.segment("hand_r")
    quality[3, lost], std[5, unsure] = 0.0, 0.2
    data = content(figure(replace(motion, segment_quality=quality, joint_std=std)))
    S = len(motion.body.tree.segments)
    marks = {key: unpacked(data[key], "u1", 1)[:, 0] for key in ("lost", "uncertain")}
    bits = {key: np.unpackbits(packed)[: 20 * S].reshape(20, S) for key, packed in marks.items()}
    assert np.argwhere(bits["lost"]).tolist() == [[3, lost]]
    assert np.argwhere(bits["uncertain"]).tolist() == [[5, motion.body.tree.parents[unsure]], [5, unsure]]
    clean = content(figure(replace(motion, segment_quality=np.ones_like(quality), joint_std=0 * std)))
    assert clean["lost"] == clean["uncertain"] == ""


def test_long_and_fast_motions_are_thinned():
    assert content(figure(smooth_motion(60, rate=60.0)))["frames"] == 15
    data = content(figure(smooth_motion(2 * MAX_FIGURE_FRAMES, rate=15.0)))
    assert data["frames"] == MAX_FIGURE_FRAMES and data["rate"] == 7.5


def test_without_surfaces_there_are_bones_and_no_skin(motion):
    data = content(figure(replace(motion, body=replace(motion.body, surfaces=()))))
    assert data["skin"] is None and len(data["ends"]) == 2 * len(data["radii"]) > 20


def test_a_live_figure_stands_at_rest_and_knows_how_to_turn():
    body = load_body("humanoid")
    data = content(live_figure(body, "x"))
    assert data["frames"] == 1 and np.allclose(data["turn"], rotation_between_up("x", "z"))
    head, foot = (poses(data)[0, body.tree.segment(name), 2, 3] for name in ("head", "foot_l"))
    assert head > foot + 1.2
