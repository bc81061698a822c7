"""From a folder with four videos of ten seconds to the report: time against the length of the videos, and memory.

The balancing trial's videos, played forward and backward to ten seconds at 60 Hz, encoded anew; `kinefit track FOLDER`
in its three steps, a process each, no height given. What matters is the number of frames: the person
moves no more than in the recording.
"""

from __future__ import annotations

import resource
import tempfile
import time
from functools import partial
from pathlib import Path

import av

from benchmarks.commands import ended
from benchmarks.figures import figure, whole_recording
from benchmarks.timing import took
from kinefit.readers.videos.video import Video

_SECONDS, _RATE = 10.0, 60


def run() -> None:
    """Print every figure of time and memory."""
    trial = whole_recording("video_balancing_4cam")
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "take"
        folder.mkdir()
        for path in sorted((trial / "videos").glob("*.mp4")):
            _played(path, folder / path.name)
        spent = {}
        for step in (["init", "."], ["detect", "take.toml"], ["track", "take.toml"]):
            _, spent[step[0]] = took(partial(ended, *step, cwd=folder, check=True), clock=time.perf_counter)
        whole = 4.0 * _SECONDS
        print("# " + ", ".join(f"{name} {seconds:.0f} s" for name, seconds in spent.items()))
        figure("phones_speed", sum(spent.values()) / whole, "x the length of all videos", "<= 6")
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
        figure("phones_memory", most, "GB", "<= 2")


def _played(source: Path, path: Path) -> None:
    """The video forward and backward until it is long enough."""
    with Video(source) as video, av.open(str(path), "w") as target:
        images = [video.read(i) for i in range(len(video))]
        images += images[-2:0:-1]
        stream = target.add_stream("mpeg4", rate=_RATE)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *video.size, "yuv420p", 12_000_000
        for i in range(round(_SECONDS * _RATE)):
            frame = av.VideoFrame.from_ndarray(images[i % len(images)], format="rgb24")
            target.mux(stream.encode(frame))
        target.mux(stream.encode())
