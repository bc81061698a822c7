"""Time offsets from motion: whole frames, fractions, and the refusal where nothing moves."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.findings import Edit
from kinefit.fitting.multiview.views import make_views
from kinefit.rigs.diagnostics.checks import check_keypoints
from kinefit.rigs.diagnostics.timing import _jackknife, _speed, fast_pixels, shifted, time_offsets
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

FINE = 10  # frames of the fine motion are one of the recording
MOTION = squat_and_wave(rate=30.0 * FINE, duration=3.0)
RIG = studio_rig(MOTION)
NOISY = simulate_keypoints(MOTION, RIG, noise_px=3.0, outliers=0.1, missing=0.1, seed=4)


def recorded(late, records=NOISY):
    """What cameras that began so many frames later recorded."""
    out = []
    for k, frames in zip(records, late, strict=True):
        rows = slice(round((6 + frames) * FINE), None, FINE)
        out.append(replace(k, points=k.points[rows], confidence=k.confidence[rows], rate=k.rate / FINE))
    length = min(len(k) for k in out)
    return [replace(k, points=k.points[:length], confidence=k.confidence[:length]) for k in out]


@pytest.mark.parametrize(
    "late", [(0, 0, 0, 0), (0, 5, 0, 0), (0.3, -0.3, 0, 0), (0, 0, -4.6, 0), (2.0, 0.0, 0.4, -3.0)]
)
def test_offsets_are_found_to_a_tenth_of_a_frame(late):
    found = time_offsets(make_views(RIG, recorded(late)))
    assert found.frames == pytest.approx(np.array(late) - np.median(late), abs=0.1)
    assert np.all(found.std * found.rate < 0.1)
    assert found.offsets == pytest.approx(found.frames / 30.0)


def test_points_that_disagree_make_an_offset_unsure():
    """Each block tells the delay of one camera against another: the standard error is that of their mean."""
    told, row = np.array([0.1, -0.3, 2.0, 0.4, 0.3]), np.array([1.0, -1.0])
    matrix, right = np.tile(np.outer(row, row), (5, 1, 1)), told[:, None] * row
    std = _jackknife(np.concatenate([matrix, np.zeros((3, 2, 2))]), np.concatenate([right, np.zeros((3, 2))]))
    assert std == pytest.approx(np.full(2, 0.5 * told.std(ddof=1) / np.sqrt(5)))  # half of it on either camera


def test_two_cameras_are_told_against_the_first():
    found = time_offsets(make_views(RIG.select(("cam01", "cam02")), recorded((0, 3, 0, 0))[:2]))
    assert found.frames[0] == 0
    assert found.frames[1] == pytest.approx(3, abs=0.1)


def test_an_offset_that_the_take_tells_already_is_no_news():
    told = [replace(k, time_offset=0.3 / 30.0) if k.camera == "cam02" else k for k in recorded((0, 0.3, 0, 0))]
    assert time_offsets(make_views(RIG, told)).frames == pytest.approx(np.zeros(4), abs=0.1)


@pytest.mark.parametrize(("late", "severity"), [(5.0, "fault"), (0.3, "doubt")])
def test_the_line_to_write_stands_in_the_finding(late, severity):
    check = check_keypoints(RIG, recorded((0, late, 0, 0)))
    found = [f for f in check.findings if f.kind == "time"]
    assert [(f.severity, f.cameras) for f in found] == [(severity, ("cam02",))]
    value = float(found[0].remedy.partition("time_offset = ")[2].split()[0])
    assert found[0].edits == (Edit("camera", "time_offset", f"{value:.4f}", "cam02"),)
    assert value == pytest.approx(late / 30.0, abs=0.1 / 30.0)
    assert not [f for f in check.findings if f.kind != "time" and f.severity in ("fault", "doubt")]


def test_a_person_who_stands_still_tells_no_offset():
    random = np.random.default_rng(0)
    plain = recorded((0, 0, 0, 0), simulate_keypoints(MOTION, RIG, noise_px=0, outliers=0, missing=0))
    still = [
        replace(k, points=k.points[:1] + random.normal(0, 3, k.points.shape), confidence=0 * k.confidence + 0.9)
        for k in plain
    ]
    found = time_offsets(make_views(RIG, still))
    assert np.isnan(found.offsets).all()
    assert np.isinf(found.std).all()
    check = check_keypoints(RIG, still)
    assert "Too little motion" in next(f.text for f in check.findings if f.kind == "time")
    assert not check.faults


def test_too_few_frames_tell_nothing():
    assert np.isnan(time_offsets(make_views(RIG, recorded((0, 0, 0, 0))).at(np.arange(8))).offsets).all()


def test_views_are_shifted_straight_between_frames():
    views = make_views(RIG, recorded((0, 0, 0, 0)))
    ramp = np.arange(len(views), dtype=float)[:, None, None, None] + np.zeros(views.uv.shape)
    moved = shifted(replace(views, uv=ramp), (0.0, 0.25, 2.0, -1.5))
    middle = slice(5, -5)
    for c, delay in enumerate((0.0, 0.25, 2.0, -1.5)):
        assert moved.uv[middle, :, c] == pytest.approx(ramp[middle, :, c] - delay)
    assert np.isnan(moved.uv[:2, :, 2]).all()
    assert np.isnan(moved.uv[-2:, :, 3]).all()


def test_speeds_are_slopes_and_those_of_noise_are_none():
    random = np.random.default_rng(1)
    t = np.arange(60.0)[:, None, None]
    x = 0.02 * t * np.array([[1.0, 0.5, 0.0]]) + random.normal(0, 0.005, (60, 1, 3))
    x[20] += 3.0  # a stray
    found = _speed(x, 4)
    assert found[5:-5, 0] == pytest.approx(np.tile([0.02, 0.01, 0.0], (50, 1)), abs=0.006)
    still = _speed(random.normal(0, 0.005, (60, 20, 3)), 4)
    assert np.mean(np.all(still == 0, axis=-1)) > 0.6
    assert np.linalg.norm(still, axis=-1).mean() < 3e-4  # half of what the plain slopes have
    fast = fast_pixels(make_views(RIG, recorded((0, 0, 0, 0))))
    assert all(5 < v < 60 for v in fast.values())
