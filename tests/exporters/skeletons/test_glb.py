"""GLB, read by nothing but json and struct."""

import json
import struct
from collections import Counter

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.bodies.rendering.looks import body_mesh
from kinefit.errors import ExportError
from kinefit.exporters import write_glb


class Glb:
    """A binary glTF file."""

    def __init__(self, path):
        data = path.read_bytes()
        magic, version, total, length, kind = struct.unpack("<4sIII4s", data[:20])
        assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
        self.json = json.loads(data[20 : 20 + length])
        size, kind = struct.unpack("<I4s", data[20 + length : 28 + length])
        assert kind == b"BIN\0" and 28 + length + size == total
        self.binary = data[28 + length :]

    def array(self, number):
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5121: "u1"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        flat = np.frombuffer(self.binary, kind, accessor["count"] * width, view.get("byteOffset", 0))
        return flat.reshape(-1, width)

    def channels(self):
        animation = self.json["animations"][0]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            node, path = channel["target"]["node"], channel["target"]["path"]
            yield node, path, self.array(sampler["input"]), self.array(sampler["output"])

    def poses(self, frame):
        """Poses of all nodes in the world, (N, 4, 4); without a frame as the nodes stand in the file."""
        nodes = self.json["nodes"]
        local = [self._local(node.get("translation", [0, 0, 0]), node.get("rotation", [0, 0, 0, 1])) for node in nodes]
        for node, path, _, values in self.channels() if frame is not None else ():
            value = values[frame].astype(float)
            if path == "rotation":
                local[node][:3, :3] = self._local([0, 0, 0], value)[:3, :3]
            else:
                local[node][:3, 3] = value
        out = np.zeros((len(nodes), 4, 4))

        def walk(node, T):
            out[node] = T @ local[node]
            for child in nodes[node].get("children", []):
                walk(child, out[node])

        for root in self.json["scenes"][0]["nodes"]:
            walk(root, np.eye(4))
        return out

    @staticmethod
    def _local(translation, rotation):
        x, y, z, w = rotation
        T = np.eye(4)
        T[0, :3] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        T[1, :3] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        T[2, :3] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        T[:3, 3] = translation
        return T


@pytest.fixture(scope="module", params=[None, "humanoid_face"])
def motion(request):
    return smooth_motion(60, up="z", turns=2.0, body=request.param and load_body(request.param))


@pytest.fixture(scope="module")
def glb(motion, tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    write_glb(motion, path)
    return Glb(path)


def test_joints_are_where_the_motion_has_them(motion, glb):
    truth = motion.turned("y").segment_poses()
    joints = glb.json["skins"][0]["joints"]
    assert [glb.json["nodes"][j]["name"] for j in joints] == list(motion.body.tree.segments)
    for frame in range(len(motion)):
        assert np.abs(glb.poses(frame)[joints, :3, 3] - truth[frame, :, :3, 3]).max() < 1e-5


def test_time_starts_at_zero_and_quaternions_do_not_change_sign(motion, glb):
    seen = Counter()
    for _, path, times, values in glb.channels():
        assert times[:, 0] == pytest.approx(motion.times - motion.times[0], abs=1e-6)
        seen[path] += 1
        if path == "rotation":
            assert np.linalg.norm(values, axis=1) == pytest.approx(1, abs=1e-6)
            assert np.all(np.sum(values[1:] * values[:-1], axis=1) > 0.5)
    assert seen == {"rotation": len(motion.body.tree.segments), "translation": 1}


def test_skin_rests_in_its_bind_pose_and_follows_the_joints(motion, glb):
    skin, primitive = glb.json["skins"][0], glb.json["meshes"][0]["primitives"][0]
    get = {name: glb.array(n).astype(float) for name, n in primitive["attributes"].items()}
    bind = glb.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
    assert np.abs(glb.poses(None)[skin["joints"]] @ bind - np.eye(4)).max() < 1e-6
    assert get["WEIGHTS_0"].sum(1) == pytest.approx(1, abs=1e-6) and get["WEIGHTS_0"].min() >= 0
    move = glb.poses(17)[skin["joints"]] @ bind
    homogeneous = np.c_[get["POSITION"], np.ones(len(get["POSITION"]))]
    skinned = np.einsum("vk,vkij,vj->vi", get["WEIGHTS_0"], move[get["JOINTS_0"].astype(int)], homogeneous)[:, :3]
    truth = motion.turned("y").segment_poses()[17, :, :3, 3]
    for surface in motion.body.surfaces:  # the skin of each segment stays about its joint
        near = np.linalg.norm(skinned - truth[surface.segment], axis=1).min()
        assert near < 1.3 * np.max(surface.radii), motion.body.tree.segments[surface.segment]


@pytest.mark.parametrize("cylinders", [False, True])
def test_mesh_is_closed_smooth_and_turned_outwards(cylinders):
    body = load_body("humanoid")
    mesh = body_mesh(body, cylinders=cylinders)
    edges = np.concatenate([mesh.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    there, back = Counter(map(tuple, edges.tolist())), Counter(map(tuple, edges[:, ::-1].tolist()))
    assert there == back and set(there.values()) == {1}
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    outward = np.cross(b - a, c - a)
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1)
    folded = np.sum(outward * mesh.normals[mesh.triangles].sum(1), axis=1) <= 0
    assert folded.mean() < 0.001 and (not folded.any() or not cylinders)  # a few in the armpits of arms at rest
    assert 0.03 < np.sum(a * outward) / 6 < 0.12  # [m³] a person's volume, overlaps counted twice


def test_limbs_end_where_their_surfaces_end():
    body = load_body("humanoid")
    top = body.tree.rest[body.tree.segment("head")] + [0.03, 0.25, 0.0]
    assert body_mesh(body).vertices[:, 1].max() == pytest.approx(top[1], abs=0.005)


def test_one_frame_will_do_and_none_is_refused(tmp_path):
    write_glb(smooth_motion(1), tmp_path / "a.glb")
    assert Glb(tmp_path / "a.glb").poses(0).shape[0] == 21
    with pytest.raises(ExportError, match="without frames"):
        write_glb(smooth_motion(0), tmp_path / "b.glb")
