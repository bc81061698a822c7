"""Long takes: little memory a frame, the same motion wherever measurements are kept, no file left behind."""

import gc
import tempfile
import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, STILL, a_motion, a_rig, depth_frame, keypoint_frame

from kinefit import Recording, track
from kinefit.errors import ObservationError
from kinefit.fitting.smoothing import spool
from kinefit.fitting.smoothing.smoother import smooth_results
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking import motions
from kinefit.fitting.tracking.checkpoints.checkpoint import TrackingInterrupted

SUBJECT = Subject(BODY, np.ones(len(BODY.scale_groups)))
FIELDS = ("Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality")


def frames_at(i, k, depth):
    """What is seen at step `i`: what the movement shows at its frame `k`."""
    seen = [keypoint_frame(k, camera) for camera in ("left", "right")] + ([depth_frame(k)] if depth else [])
    return [replace(frame, time=i / RATE) for frame in seen]


def recording(count, depth, stop=None):
    """To and fro over the first 24 frames; `stop`: what step 10 raises."""
    order = np.resize(np.concatenate([np.arange(24), np.arange(22, 0, -1)]), count)
    steps = [frames_at(i, int(k), depth) for i, k in enumerate(order)]
    sigma = dict.fromkeys(("left", "right"), 2.0)
    whole = Recording.of_frames(steps, a_rig(), rate=RATE, sigma=sigma, start=(0, a_motion().state(0)), up="z")
    if stop is None:
        return whole
    given = whole.steps

    def until(i):
        if i == 10:
            raise stop("a broken image")  # a new one: it keeps alive what it came through
        return given(i)

    return replace(whole, steps=until)


def followed(*args, **more):
    return track(recording(*args), BODY, subject=SUBJECT, settings=STILL, **more)


def open_files(folder):
    return [p for p in Path("/proc/self/fd").iterdir() if p.is_symlink() and str(p.readlink()).startswith(str(folder))]


@pytest.mark.parametrize("options", [{}, {"smooth": False}, {"lag": 0.1}, {"contacts": True}])
def test_the_motion_is_the_same_wherever_measurements_are_kept(options, tmp_path, monkeypatch):
    usual = followed(14, True, **options)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(spool, "IN_MEMORY", 0)
    kept = followed(14, True, **options)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(kept, field), getattr(usual, field), err_msg=field)
    assert set(kept.residuals) == set(usual.residuals) == {"left", "right", "depth"}
    for name, rest in kept.residuals.items():
        np.testing.assert_array_equal(rest.values, usual.residuals[name].values)
    assert kept.provenance == usual.provenance
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs a list of open files")
@pytest.mark.parametrize("stop", [None, KeyboardInterrupt, ObservationError])
def test_no_file_is_left_behind(stop, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(spool, "IN_MEMORY", 0)
    made = []
    write = spool.Store.write
    monkeypatch.setattr(spool.Store, "write", lambda *a: made.append(len(open_files(tmp_path))) or write(*a))
    if stop is None:
        followed(12, True)
    else:
        expected = TrackingInterrupted if stop is KeyboardInterrupt else stop
        with pytest.raises(expected):
            followed(12, True, stop, smooth=False)
    assert max(made) > 0  # there was one
    gc.collect()
    assert not open_files(tmp_path) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("depth", [False, True])
def test_a_frame_needs_little_memory(depth, monkeypatch):
    """Twice the 15 kB that keypoints of two cameras need on this body; what depth images add goes to the file."""
    monkeypatch.setattr(spool, "IN_MEMORY", 2**18)
    monkeypatch.setattr(motions, "smooth_results", partial(smooth_results, windows=(12, 6)))
    peaks, counts = [], (16, 16, 40)  # the first makes what is made once
    for count in counts:
        whole = recording(count, depth)
        gc.collect()
        tracemalloc.start()
        track(whole, BODY, subject=SUBJECT, settings=STILL)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (peaks[2] - peaks[1]) / (counts[2] - counts[1]) < 30e3
