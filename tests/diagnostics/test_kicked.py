"""A camera that is moved during a recording is named, with the frame; one that is turned all the time is not."""

import numpy as np
import pytest

from kinefit.diagnostics.checks import check_keypoints
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

MOTION = squat_and_wave(duration=5.0)
RIG = studio_rig(MOTION)
NOISE = {"noise_px": 3.0, "outliers": 0.1, "missing": 0.1, "seed": 8}


def turned(rig, name, degrees, axis):
    T = se3.transform(se3.exp_so3(np.radians(degrees) * np.eye(3)[axis]), np.zeros(3))
    return Rig(tuple(c.with_pose(T @ c.T_camera_world) if c.name == name else c for c in rig))


def kicked(rig, name, at, degrees, axis):
    """Keypoints of a camera that is turned from a frame on."""
    before, after = (simulate_keypoints(MOTION, r, **NOISE) for r in (rig, turned(rig, name, degrees, axis)))
    for a, b in zip(before, after):
        a.points.flags.writeable = a.confidence.flags.writeable = True
        a.points[at:], a.confidence[at:] = b.points[at:], b.confidence[at:]
    return before


@pytest.mark.parametrize(("name", "at", "degrees", "axis"), [("cam02", 60, 1.0, 0), ("cam01", 100, 2.0, 1),
                                                             ("cam04", 85, 4.0, 2), ("cam03", 50, 6.0, 0)])  # fmt: skip
def test_the_moved_camera_is_named_with_its_frame(name, at, degrees, axis):
    found = check_keypoints(RIG, kicked(RIG, name, at, degrees, axis)).findings
    found = [f for f in found if f.severity in ("fault", "doubt")]
    assert [(f.severity, f.kind, f.cameras) for f in found] == [("fault", "kicked", (name,))]
    assert int(found[0].text.partition("moved at frame ")[2].partition(":")[0]) == pytest.approx(at, abs=4)


def test_of_three_cameras_the_moved_one_is_named_too():
    rig = RIG.select(("cam01", "cam02", "cam04"))
    found = check_keypoints(rig, kicked(rig, "cam02", 70, 2.0, 0)).faults
    assert [(f.kind, f.cameras) for f in found] == [("kicked", ("cam02",))]


def test_a_camera_turned_all_the_time_did_not_move():
    seen = simulate_keypoints(MOTION, RIG, **NOISE)
    for rig in (RIG, turned(RIG, "cam02", 1.0, 0)):
        assert not [f for f in check_keypoints(rig, seen).findings if f.kind == "kicked"]
