"""OpenSim's files, read by a small model of what OpenSim makes of them."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.errors import ExportError
from kinefit.exporters import write_mot, write_osim, write_trc
from kinefit.exporters.opensim import mass_properties
from kinefit.geometry import se3


def read_mot(path):
    lines = path.read_text().splitlines()
    head = lines.index("endheader")
    assert "inDegrees=yes" in lines[:head]
    table = np.array([line.split("\t") for line in lines[head + 2 :]], float)
    assert f"nRows={len(table)}" in lines[:head] and f"nColumns={table.shape[1]}" in lines[:head]
    return dict(zip(lines[head + 1].split("\t"), table.T))


def poses_by_opensim(path, columns):
    """{body: (F, 4, 4)} of a model in given coordinates: the way, then three turns about axes in the body."""
    model = ET.parse(path).getroot().find("Model")
    count = len(columns["time"])
    Ts = {"/ground": np.tile(np.eye(4), (count, 1, 1))}
    for joint in model.find("JointSet/objects"):
        offsets = joint.findall("frames/PhysicalOffsetFrame")
        parent, child = (frame.find("socket_parent").text for frame in offsets)
        at, back = (np.array(frame.find("translation").text.split(), float) for frame in offsets)
        assert not back.any() and joint.find("socket_parent_frame").text == offsets[0].get("name")
        T = Ts[parent] @ se3.transform(np.eye(3), at)
        axes = {}
        for axis in joint.findall("SpatialTransform/TransformAxis"):
            name, direction = axis.find("coordinates").text, np.array(axis.find("axis").text.split(), float)
            axes[axis.get("name")] = (columns[name] if name else np.zeros(count))[:, None] * direction
        if axes:
            T = T @ se3.transform(np.eye(3), sum(axes[f"translation{k}"] for k in (1, 2, 3)))
            for k in (1, 2, 3):
                T = T @ se3.transform(se3.exp_so3(np.radians(axes[f"rotation{k}"])), np.zeros(3))
        Ts[child] = T
    return model, {name.removeprefix("/bodyset/"): T for name, T in Ts.items()}


@pytest.mark.parametrize("up", ["y", "z"])
def test_model_and_angles_give_the_motion(tmp_path, up):
    motion = smooth_motion(25, up=up)
    write_osim(motion.body, tmp_path / "a.osim")
    write_mot(motion, tmp_path / "a.mot")
    columns = read_mot(tmp_path / "a.mot")
    model, poses = poses_by_opensim(tmp_path / "a.osim", columns)
    y_up = motion.turned("y")
    for s, T in zip(motion.body.tree.segments, np.moveaxis(y_up.segment_poses(), 1, 0)):
        assert np.abs(poses[motion.body.alias("opensim", s)] - T).max() < 1e-6, s
    markers = model.findall("MarkerSet/objects/Marker")
    assert [m.get("name") for m in markers] == list(motion.body.landmarks.names)
    for marker, x in zip(markers, np.moveaxis(y_up.positions(), 1, 0)):
        T = poses[marker.find("socket_parent_frame").text.removeprefix("/bodyset/")]
        assert np.abs(se3.apply(T, np.array(marker.find("location").text.split(), float)) - x).max() < 1e-6
    assert {c.get("name") for c in model.iter("Coordinate")} == set(columns) - {"time"}
    assert {"pelvis_tilt", "pelvis_tx", "hip_flexion_r", "knee_angle_l"} <= set(columns)


def test_limits_masses_and_bodies_are_usable(tmp_path):
    body = load_body("humanoid")
    write_osim(body, tmp_path / "a.osim")
    model = ET.parse(tmp_path / "a.osim").getroot().find("Model")
    knee = next(c for c in model.iter("Coordinate") if c.get("name") == "knee_angle_r")
    assert np.degrees(np.array(knee.find("range").text.split(), float)) == pytest.approx([-10, 160])
    masses = [float(b.find("mass").text) for b in model.iter("Body")]
    assert min(masses) > 0.1 and sum(masses) == pytest.approx(75, abs=1)
    for b in model.iter("Body"):
        xx, yy, zz, xy, xz, yz = np.array(b.find("inertia").text.split(), float)
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert principal[0] > 0 and principal[0] + principal[1] >= principal[2]


def test_the_mass_given_and_its_centres_are_in_the_model(tmp_path):
    motion = smooth_motion(3).with_mass(32.0)
    write_osim(motion.body, tmp_path / "a.osim")
    write_mot(motion, tmp_path / "a.mot")
    model, poses = poses_by_opensim(tmp_path / "a.osim", read_mot(tmp_path / "a.mot"))
    masses, centres = [], []
    for body in model.iter("Body"):
        masses.append(float(body.find("mass").text))
        centres.append(se3.apply(poses[body.get("name")], np.array(body.find("mass_center").text.split(), float)))
    assert sum(masses) == pytest.approx(32.0)
    centre = np.einsum("s,sfi->fi", masses, centres) / 32.0
    np.testing.assert_allclose(centre, motion.turned("y").centre_of_mass, atol=1e-6)


@pytest.mark.parametrize("end", [(0.0, 0.3, 0.0), (0.1, -0.2, 0.05), (0.0, -0.3, 0.0), (0.3, 0.0, 0.0)])
def test_inertia_is_that_of_a_round_rod(end):
    from kinefit.bodies import TaperedCylinder

    mass, centre, inertia = mass_properties([TaperedCylinder.round(0, end, (0.05, 0.05))])
    length = np.linalg.norm(end)
    assert mass == pytest.approx(1000 * np.pi * 0.05**2 * length)
    u = np.array(end) / length
    assert u @ inertia @ u == pytest.approx(mass * 0.05**2 / 2)
    assert np.trace(inertia) == pytest.approx(mass * (0.05**2 / 2 + 2 * (3 * 0.05**2 + length**2) / 12))
    assert centre == pytest.approx(0.5 * np.array(end))


@pytest.mark.parametrize(("unit", "per_metre"), [("m", 1.0), ("mm", 1000.0)])
def test_trc_holds_the_landmarks_y_up(tmp_path, unit, per_metre):
    motion = smooth_motion(10, up="z")
    write_trc(motion, tmp_path / "a.trc", unit=unit)
    lines = (tmp_path / "a.trc").read_text().splitlines()
    head = dict(zip(lines[1].split("\t"), lines[2].split("\t")))
    assert head["Units"] == unit and head["NumFrames"] == "10" and head["NumMarkers"] == str(len(motion.body.landmarks))
    assert tuple(lines[3].split("\t")[2::3]) == motion.body.landmarks.names
    assert len(lines[4].split("\t")) == 2 + 3 * len(motion.body.landmarks) and lines[5] == ""
    table = np.array([line.split("\t") for line in lines[6:]], float)
    assert table[:, 1] == pytest.approx(motion.times)
    assert table[:, 2:] / per_metre == pytest.approx(motion.turned("y").positions().reshape(10, -1), abs=1e-7)
    with pytest.raises(ExportError, match="there are: m, cm, mm"):
        write_trc(motion, tmp_path / "b.trc", unit="inch")


def test_trc_of_chosen_points(tmp_path):
    motion = smooth_motion(4)
    points = motion.body.markers("HANIM_45")
    write_trc(motion, tmp_path / "a.trc", points)
    lines = (tmp_path / "a.trc").read_text().splitlines()
    assert tuple(lines[3].split("\t")[2::3]) == points.names
    assert np.array(lines[6].split("\t")[2:], float) == pytest.approx(motion.positions(points)[0].ravel(), abs=1e-7)
