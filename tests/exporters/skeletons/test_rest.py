"""Rest poses: the T that animation programs expect, with joints and skin where they belong."""

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion
from tests.exporters.test_options import bvh_positions, glb_positions, same

from kinefit.bodies import load_body
from kinefit.bodies.rendering.looks import body_mesh
from kinefit.errors import ExportError
from kinefit.exporters import write_bvh, write_glb, write_usd
from kinefit.exporters.skeletons.common import rest_pose
from kinefit.readers.skeletons.bvh import read_bvh


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(15, up="z", turns=0.5)


def at(body, rest, segment):
    return rest.positions[body.tree.segment(segment)]


def test_a_t_faces_z_with_the_arms_out_and_the_palms_down():
    body = load_body("humanoid")
    t = rest_pose(body, "t", "kinefit", "")
    for side, sign in (("r", -1), ("l", 1)):  # it faces z, so its right is at -x
        arm = at(body, t, f"hand_{side}") - at(body, t, f"upperarm_{side}")
        assert arm / np.linalg.norm(arm) == pytest.approx([sign, 0, 0], abs=1e-9)
        leg = at(body, t, f"foot_{side}") - at(body, t, f"thigh_{side}")
        assert leg / np.linalg.norm(leg) == pytest.approx([0, -1, 0], abs=1e-9)
        toes = at(body, t, f"toes_{side}") - at(body, t, f"foot_{side}")
        assert toes[2] > 0.1
        hand, forearm = body.tree.segment(f"hand_{side}"), body.tree.segment(f"forearm_{side}")
        assert t.turns[hand] @ [1, 0, 0] == pytest.approx([0, -1, 0], abs=1e-9)  # a palm looks along x of its segment
        elbow = t.turns[body.tree.segment(f"upperarm_{side}")] @ [0, 0, 1]
        assert np.abs(elbow) == pytest.approx([0, 1, 0], abs=1e-9)  # elbows bend forward
        assert np.array_equal(t.turns[hand], t.turns[forearm])
    lengths = np.linalg.norm(t.offsets, axis=1)
    assert lengths == pytest.approx(np.linalg.norm(body.tree.offsets, axis=1))


def test_the_bodys_own_rest_changes_nothing(motion):
    rest = rest_pose(motion.body, "body", "mixamo", "")
    assert np.array_equal(rest.offsets, motion.body.tree.offsets)
    assert rest.positions == pytest.approx(motion.body.tree.rest)
    mesh = body_mesh(motion.body)
    assert rest.posed(mesh, motion.body).vertices == pytest.approx(mesh.vertices)


def test_names_of_characters_come_with_a_t(motion):
    for names in ("kinefit", "bvh", "cmu", "opensim", "hanim"):
        assert np.array_equal(rest_pose(motion.body, None, names, "").turns, np.tile(np.eye(3), (20, 1, 1)))
    t = rest_pose(motion.body, "t", "kinefit", "").turns
    for names in ("mixamo", "vrm", "unity", "Unreal"):
        assert np.array_equal(rest_pose(motion.body, None, names, "").turns, t)


def test_a_person_who_stands_in_the_rest_pose_has_no_rotation_in_the_file(motion):
    rest, parents = rest_pose(motion.body, "t", "kinefit", ""), motion.body.tree.parents
    local = rest.local_poses(motion)
    assert local[:, 0, :3, 3] == pytest.approx(motion.segment_poses()[:, 0, :3, 3])
    for s in range(1, len(parents)):
        assert local[:, s, :3, 3] == pytest.approx(np.tile(rest.offsets[s], (len(motion), 1)), abs=1e-12)
    world = motion.segment_poses()[..., :3, :3]
    for s, parent in enumerate(parents):
        above = world[:, parent] @ rest.turns[parent].T if parent >= 0 else np.eye(3)
        assert above @ local[:, s, :3, :3] @ rest.turns[s] == pytest.approx(world[:, s], abs=1e-12)


@pytest.mark.parametrize("rest", ["body", "t"])
def test_joints_do_not_move(motion, tmp_path, rest):
    write_bvh(motion, tmp_path / "a.bvh", rest=rest, up="z", unit="m")
    same(bvh_positions(tmp_path / "a.bvh"), motion, "z", "bvh", "m")
    write_glb(motion, tmp_path / "a.glb", rest=rest)
    same(glb_positions(tmp_path / "a.glb"), motion, "y", "kinefit", "m")


def test_ends_of_limbs_are_turned_too(motion, tmp_path):
    write_bvh(motion, tmp_path / "a.bvh", rest="t", unit="m")
    back = read_bvh(tmp_path / "a.bvh", unit=1.0)
    end = back.offsets[back.names.index("RightHand_end")]
    assert end / np.linalg.norm(end) == pytest.approx([-1, 0, 0], abs=1e-6)


def test_the_skin_of_a_t_lies_about_its_bones_and_faces_outwards():
    body = load_body("humanoid")
    rest = rest_pose(body, "t", "kinefit", "")
    mesh = rest.posed(body_mesh(body), body)
    assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(np.ptp(mesh.vertices[:, 1]), rel=0.15)  # span and stature
    for surface in body.surfaces:
        near = np.linalg.norm(mesh.vertices - rest.positions[surface.segment], axis=1).min()
        assert near < 1.3 * np.max(surface.radii)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    outward = np.cross(b - a, c - a)
    area = np.linalg.norm(outward, axis=1)
    ahead = np.sum(outward * mesh.normals[mesh.triangles].sum(1), axis=1) > 0
    assert area[~ahead].sum() < 0.01 * area.sum()  # but for folds in the armpits
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1)


def test_skinned_usd_agrees_with_either_rest(motion, tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom
    from tests.exporters.skeletons.test_usd import skinning

    hands = {}
    for rest in ("body", "t"):
        write_usd(motion, tmp_path / f"{rest}.usdc", rest=rest)
        stage = Usd.Stage.Open(str(tmp_path / f"{rest}.usdc"))
        skeleton, skinned = skinning(stage)
        points = UsdGeom.Mesh(stage.GetPrimAtPath("/Figure/Surface")).GetPointsAttr().Get()
        assert skinned.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(7), points, 7)
        hands[rest] = np.array(points)
    alone = body_mesh(motion.body).weights[:, 0] == 1.0  # away from joints the skin is the same
    assert np.abs(hands["t"] - hands["body"])[alone].max() < 1e-5


def test_an_unknown_rest_pose_is_refused(motion, tmp_path):
    for write in (write_bvh, write_glb):
        with pytest.raises(ExportError, match="'a'; there are: body, t"):
            write(motion, tmp_path / "a.x", rest="a")
    assert not list(tmp_path.iterdir())
