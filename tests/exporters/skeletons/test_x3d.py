"""X3D: parsed strictly, joints recomputed as H-Anim defines its transforms."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.errors import ExportError
from kinefit.exporters import write_x3d
from kinefit.exporters.skeletons.common import bone_names


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(12, up="z", turns=0.6)


def numbers(text, width):
    return np.array(text.split(), float).reshape(-1, width)


class Scene:
    """An X3D scene: what is named, and which interpolator feeds which field of which node."""

    def __init__(self, path):
        root = ET.parse(path).getroot()
        assert root.tag == "X3D" and root.get("version") == "4.0"
        self.named = {}
        for node in root.iter():
            if name := node.get("DEF"):
                assert name not in self.named
                self.named[name] = node
        assert all(node.get("USE") in self.named for node in root.iter() if node.get("USE"))
        routes = [{k: r.get(k) for k in ("fromNode", "fromField", "toNode", "toField")} for r in root.iter("ROUTE")]
        fed = {r["toNode"] for r in routes if r["fromNode"] == "clock" and r["fromField"] == "fraction_changed"}
        self.feeds = {
            (r["toNode"], r["toField"].removeprefix("set_")): self.named[r["fromNode"]]
            for r in routes if r["fromField"] == "value_changed"
        }  # fmt: skip
        assert {node.get("DEF") for node in self.feeds.values()} == fed
        self.clock = root.find(".//TimeSensor")
        (self.humanoid,) = root.iter("HAnimHumanoid")

    def positions(self):
        """{joint: (F, 3)}: a joint's transform is a move, then a turn about its centre, after those above it."""
        out = {}

        def walk(node, move, turn):  # x_world = turn x + move, of x at rest
            name, centre = node.get("DEF"), numbers(node.get("center"), 3)[0]
            axes = numbers(self.feeds[name, "rotation"].get("keyValue"), 4)
            own = Rotation.from_rotvec(axes[:, :3] * axes[:, 3:])
            shift = self.feeds.get((name, "translation"))
            shift = np.zeros(3) if shift is None else numbers(shift.get("keyValue"), 3)
            move = move + turn.apply(shift + centre - own.apply(centre))
            turn = turn * own
            out[node.get("name")] = move + turn.apply(centre)
            for child in node.findall("HAnimJoint"):
                walk(child, move, turn)

        (root,) = (j for j in self.humanoid.findall("HAnimJoint") if j.get("containerField") == "skeleton")
        walk(root, np.zeros(3), Rotation.identity())
        return out


@pytest.mark.parametrize(("names", "rest"), [(None, None), ("kinefit", "t"), ("mixamo", None)])
def test_every_joint_stands_where_it_is(motion, tmp_path, names, rest):
    write_x3d(motion, tmp_path / "a.x3d", names=names, rest=rest)
    found, truth = Scene(tmp_path / "a.x3d").positions(), motion.turned("y").joint_centres
    for s, name in enumerate(bone_names(motion.body, names or "hanim", "")):
        assert np.abs(found[name] - truth[:, s]).max() < 1e-5
    assert len(found) == truth.shape[1]


def test_joints_that_slide_move(tmp_path):
    motion = smooth_motion(6, body=load_body("snowboarder"))
    write_x3d(motion, tmp_path / "a.x3d", names="kinefit")
    found = Scene(tmp_path / "a.x3d").positions()
    assert np.abs(np.stack(list(found.values()), 1) - motion.joint_centres).max() < 1e-5


def test_it_rests_as_h_anim_asks_and_keeps_the_time(motion, tmp_path):
    write_x3d(motion, tmp_path / "a.x3d")
    scene = Scene(tmp_path / "a.x3d")
    centre = {n.get("name"): numbers(n.get("center"), 3)[0] for n in scene.named.values() if n.tag == "HAnimJoint"}
    assert centre["l_hip"][0] > 0.05 > -0.05 > centre["r_hip"][0]  # left is x, so that it faces z
    assert centre["l_radiocarpal"][1] < centre["l_elbow"][1] < centre["l_shoulder"][1]  # arms hang
    assert float(scene.clock.get("cycleInterval")) == pytest.approx(11 / motion.rate)
    for node in scene.feeds.values():
        keys = numbers(node.get("key"), 1)[:, 0]
        assert len(keys) == 12 and keys[0] == 0 and keys[-1] == 1 and np.all(np.diff(keys) > 0)
    joints = [n for n in scene.humanoid.findall("HAnimJoint") if n.get("containerField") == "joints"]
    assert len(joints) == len(motion.body.tree.segments)


def test_names_are_escaped(motion, tmp_path):
    write_x3d(replace(motion, name='a <b> & "c"'), tmp_path / "a.x3d")
    (title,) = (n for n in ET.parse(tmp_path / "a.x3d").iter("meta") if n.get("name") == "title")
    assert title.get("content") == 'a <b> & "c"'


def test_what_cannot_be_written_is_told(motion, tmp_path):
    with pytest.raises(ExportError, match="two frames"):
        write_x3d(next(motion.parts(1)), tmp_path / "a.x3d")
    with pytest.raises(ExportError, match="rest pose"):
        write_x3d(motion, tmp_path / "a.x3d", rest="sitting")
    assert not list(tmp_path.iterdir())
