"""One contract of `Motion` for every mix of sensors: deviations, quality, residuals, files, report."""

from functools import cache

import numpy as np
import pytest
from tests.fitting.tracking.movements import (
    BODY,
    RATE,
    a_motion,
    a_rig,
    depth_frame,
    keypoint_frame,
    marker_frame,
)
from tests.sensors.fakes import Rope, Seen, value

from kinefit.bodies.rendering import render_body
from kinefit.exporters.motion_file import write_motion
from kinefit.exporters.pictures.overlay import draw_overlay
from kinefit.exporters.report.report import write_report
from kinefit.exporters.tables import tables
from kinefit.fitting.tracking.cameras import contradiction_sentences
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.observations import SilhouetteFrame
from kinefit.readers.motion import read_motion
from kinefit.sensors.settings import TrackSettings

NAMES = (
    "neck", "hip_centre", "nose_tip", "r_hip", "l_hip", "r_shoulder", "l_shoulder", "r_elbow", "l_elbow", "r_wrist",
    "l_wrist", "r_knee", "l_knee", "r_ankle", "l_ankle",
)  # fmt: skip
FEW = tuple(n for n in NAMES if n not in ("l_elbow", "l_wrist"))  # nothing of the left arm
COUNT = 8


def silhouette(i, camera):
    """Which pixels show the body."""
    drawn = render_body(BODY, a_motion().state(i), a_rig()[camera])
    return SilhouetteFrame(camera, i / RATE, np.where(drawn.segment >= 0, 255, 0).astype(np.uint8))


SEEN = {
    "left": lambda i: keypoint_frame(i, "left"),
    "right": lambda i: keypoint_frame(i, "right"),
    "silhouette left": lambda i: silhouette(i, "left"),
    "depth": depth_frame,
    "mocap": lambda i: marker_frame(i, NAMES),
    "few": lambda i: marker_frame(i, FEW, sensor="few"),
    "rope": lambda i: Seen("rope", i / RATE, value("rope", i)),
}
MIXES = {
    "keypoints": ("left", "right"),
    "keypoints and silhouettes": ("left", "right", "silhouette left"),
    "keypoints and depth": ("left", "right", "depth"),
    "keypoints and markers": ("left", "right", "mocap"),
    "markers alone": ("mocap",),
    "markers of all but an arm": ("few",),
    "depth alone": ("depth",),
    "markers and a sensor of one's own": ("mocap", "rope"),
    "everything": ("left", "right", "silhouette left", "depth", "mocap", "rope"),
}
SIGMA = {"left": 2.0, "right": 2.0, "mocap": 0.004, "few": 0.004}


@cache
def tracked(mix, smooth):
    sensors = (Rope(),) if "rope" in MIXES[mix] else ()
    steps = [[SEEN[name](i) for name in MIXES[mix]] for i in range(COUNT)]
    recording = Recording.of_frames(
        steps, a_rig(), rate=RATE, sigma={n: SIGMA[n] for n in MIXES[mix] if n in SIGMA}, sensors=sensors, up="y",
        start=(0, a_motion().state(0)),
    )  # fmt: skip
    settings = TrackSettings(search=False, smooth_rounds=1)
    return track(recording, BODY, smooth=smooth, settings=settings, size=mix in ("keypoints", "markers alone"))


each = pytest.mark.parametrize("mix", MIXES)
both = pytest.mark.parametrize("smooth", [True, False], ids=["smoothed", "filtered"])


@each
@both
def test_deviations_are_positive_and_infinite_where_only_the_prior_speaks(mix, smooth):
    motion = tracked(mix, smooth)
    F, S, n = COUNT, len(BODY.tree.segments), BODY.tree.n_dofs
    assert motion.dof_std.shape == (F, n) and motion.joint_std.shape == (F, S, 3)
    assert not np.isnan(motion.dof_std).any() and (motion.dof_std > 0).all()
    assert not np.isnan(motion.joint_std).any() and (motion.joint_std > 0).all()
    assert np.isfinite(motion.dof_std[:, :6]).all()
    knees = [6 + BODY.tree.coordinate(f"knee_angle_{side}") for side in "rl"]
    right, left = (6 + BODY.tree.coordinate(f"elbow_flex_{side}") for side in "rl")
    assert np.isfinite(motion.dof_std[:, [*knees, right]]).all() and motion.dof_std[:, knees].max() < 0.5
    assert np.isinf(motion.dof_std[:, left]).all() == (mix == "markers of all but an arm")
    forearm, shank = BODY.tree.segment("forearm_l"), BODY.tree.segment("shank_l")
    assert np.isfinite(motion.joint_std[:, shank]).all()
    assert np.isinf(motion.joint_std[:, forearm]).any() == (mix == "markers of all but an arm")


@each
@both
def test_quality_is_a_share(mix, smooth):
    motion = tracked(mix, smooth)
    for values in (motion.quality, motion.segment_quality):
        assert np.isfinite(values).all() and (values >= 0).all() and (values <= 1).all()
    assert motion.quality.mean() > 0.5
    unseen = motion.segment_quality[:, BODY.tree.segment("forearm_l")]
    assert (unseen == 0).all() == (mix == "markers of all but an arm")


@each
@both
def test_residuals_are_there_of_every_sensor(mix, smooth):
    motion = tracked(mix, smooth)
    assert set(motion.residuals) == set(MIXES[mix])
    for name, r in motion.residuals.items():
        points = name in ("left", "right", "mocap", "few")
        assert r.of_points == points and r.unit == ("px" if name in ("left", "right", "silhouette left") else "m")
        assert r.values.shape == (COUNT, len(r.names), {"px": 2, "m": 3}[r.unit] if points else 1)
        assert len(r.segments) == len(r.names) and r.weights.shape == r.values.shape[:2]
        assert np.isfinite(r.values).any() and (r.weights >= 0).all() and (r.weights <= 1).all()
        assert np.nanmedian(r.norms) < (10.0 if r.unit == "px" else 0.05)
        if points:
            assert len(r.names) >= 13 and np.isfinite(r.measured).any()
        else:
            assert r.rms.shape == r.count.shape == (COUNT, len(r.names)) and r.count.sum() > 0
            assert (np.isfinite(r.rms) == (r.count > 0)).all() and (r.rms[r.count > 0] >= 0).all()


@each
@both
def test_provenance_says_what_was_done(mix, smooth):
    told = tracked(mix, smooth).provenance
    assert told["estimate"] == ("smoothed" if smooth else "filtered") and ("smoothing" in told) == smooth
    assert ("detector noise" in told) == ("left" in MIXES[mix])
    assert set(told.get("sensor noise", {})) == set(MIXES[mix]) & {"mocap", "few", "rope"}
    assert ("shape" in told) == ("rope" in MIXES[mix] or mix == "markers alone")


@each
@both
def test_a_file_keeps_everything(mix, smooth, tmp_path):
    motion = tracked(mix, smooth)
    write_motion(motion, tmp_path / "motion.npz")
    again = read_motion(tmp_path / "motion.npz")
    for name in ("times", "Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality"):
        np.testing.assert_array_equal(getattr(again, name), getattr(motion, name), err_msg=name)
    assert again.provenance == motion.provenance and again.rate == motion.rate and again.up == motion.up
    assert list(again.residuals) == list(motion.residuals)
    for sensor, r in motion.residuals.items():
        other = again.residuals[sensor]
        assert other.names == r.names and other.unit == r.unit and other.of_points == r.of_points
        more = () if r.of_points else ("rms", "count")
        for name in ("segments", "values", "weights", "measured", "swapped", *more):
            np.testing.assert_array_equal(getattr(other, name), getattr(r, name), err_msg=f"{sensor} {name}")


@each
@both
def test_a_report_names_every_sensor(mix, smooth, tmp_path):
    motion = tracked(mix, smooth)
    page = write_report(motion, tmp_path / "report.html", rig=a_rig(), date="2026-01-01").read_text("utf-8")
    for sensor in MIXES[mix]:
        assert f">{sensor}<" in page
    assert "nan" not in page.split("<script")[0].lower().replace("nanchors", "")


@each
def test_tables_tell_residuals_of_every_sensor(mix):
    made = tables(tracked(mix, True))
    assert set(np.concatenate([t["sensor"] for name, t in made.items() if "sensor" in t])) == set(MIXES[mix])


@each
def test_pictures_are_drawn(mix):
    motion = tracked(mix, False)
    for camera in ("left", "depth"):
        width, height = a_rig()[camera].size
        image = np.zeros((height, width, 3), np.uint8)
        own = motion.residuals.get(camera)
        drawn = draw_overlay(image, motion, 3, a_rig()[camera], residuals=own)
        assert drawn.shape == image.shape and drawn.any()


@each
@both
def test_sensors_that_agree_contradict_nothing(mix, smooth):
    assert tracked(mix, smooth).provenance["contradictions"] == {}


def test_sensors_that_contradict_each_other_are_told():
    """Markers that lie 15 cm beside what two cameras see: which, by how much, and where to."""
    def shifted(i):
        return marker_frame(i, NAMES, shift=np.array([0.15, 0.0, 0.0]))

    steps = [[keypoint_frame(i, "left"), keypoint_frame(i, "right"), shifted(i)] for i in range(COUNT)]
    recording = Recording.of_frames(
        steps, a_rig(), rate=RATE, sigma={"left": 2.0, "right": 2.0, "mocap": 0.004}, up="y",
        start=(0, a_motion().state(0)),
    )  # fmt: skip
    for smooth in (True, False):
        told = track(recording, BODY, smooth=smooth, size=False).provenance["contradictions"]
        assert told and set(told) <= {"keypoints", "mocap"}
        gaps = [np.array(one["shift_m"]) for one in told.values()]
        assert max(abs(g[0]) for g in gaps) > 0.05 and all(one["deviations"] > 3.0 for one in told.values())
        assert any(next(iter(told)) in text and "mm" in text for text in contradiction_sentences(told))


@pytest.mark.parametrize("mix", ["keypoints", "markers alone", "everything"])
def test_a_smoothed_motion_is_surer_than_a_filtered_one(mix):
    """Most of its coordinates: what lasts of a depth camera's errors is known to smoothing alone, and adds to some."""
    smoothed, filtered = (np.median(tracked(mix, smooth).dof_std, axis=0) for smooth in (True, False))
    assert np.median(smoothed / filtered) < 1.0
    assert np.median(smoothed[:3] / filtered[:3]) < 1.1
