"""Clocks that jump or drift within a take: which cameras, when, and by how much; constant ones are not called so."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.diagnostics.checks import check_keypoints
from kinefit.findings import Edit
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

FINE, FRAMES = 5, 220  # frames of the fine motion are one of the recording
MOTION = squat_and_wave(rate=30.0 * FINE, duration=10.0)
RIG = studio_rig(MOTION)
SEEN = simulate_keypoints(MOTION, RIG, noise_px=2.0, outliers=0.05, missing=0.05, seed=3)
EVEN = FINE * np.arange(FRAMES)


def recorded(**rows):
    """What the cameras saw at some fine frames (F,) each; in step by default."""
    own = [(k, rows.get(k.camera, EVEN)) for k in SEEN]
    return [replace(k, points=k.points[r], confidence=k.confidence[r], rate=30.0) for k, r in own]


def findings(**rows):
    return [f for f in check_keypoints(RIG, recorded(**rows)).findings if f.severity in ("fault", "doubt")]


@pytest.mark.parametrize(("name", "frames", "at"), [("cam02", 7, 90), ("cam04", 11, 140)])
def test_frames_dropped_in_mid_take_are_a_step_with_its_frame(name, frames, at):
    (found,) = findings(**{name: EVEN + np.where(np.arange(FRAMES) < at, 0, FINE * frames)})
    assert (found.severity, found.kind, found.cameras) == ("fault", "time", (name,))
    assert f"{name} is {frames} frames ({1000 * frames / 30:.0f} ms) later than" in found.text
    frame = int(found.text.partition("from frame ")[2].split()[0])
    assert frame == pytest.approx(at, abs=8)
    part = [frame, FRAMES] if at < FRAMES // 2 else [0, frame]
    assert found.edits == (Edit("take", "frames", str(part)),)


def test_two_cameras_that_drop_frames_together_are_one_finding():
    late = EVEN + np.where(np.arange(FRAMES) < 100, 0, FINE * 9)
    (found,) = findings(cam01=late, cam03=late)
    assert found.cameras == ("cam01", "cam03")
    assert "are 9 frames" in found.text and "cannot be seen" in found.confidence


@pytest.mark.parametrize(("name", "rate"), [("cam01", 25.0), ("cam03", 31.5)])
def test_another_rate_is_a_drift_and_no_offset(name, rate):
    (found,) = findings(**{name: np.round(30.0 / rate * EVEN).astype(int)[:FRAMES]})
    assert (found.severity, found.kind, found.cameras) == ("fault", "rate", (name,))
    (edit,) = found.edits
    assert (edit.table, edit.key, edit.entry) == ("keypoints", "rate", name)
    assert float(edit.value) == pytest.approx(rate, rel=0.015)


@pytest.mark.parametrize("rows", [{}, {"cam02": EVEN + 5 * FINE}, {"cam04": EVEN + 12 * FINE}])
def test_constant_offsets_are_neither(rows):
    found = findings(**rows)
    assert {name for f in found for name in f.cameras} <= set(rows)
    assert not [f for f in found if f.kind != "time" or "not before" in f.text]
