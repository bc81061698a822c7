"""How long a user waits: the demo's first fitted frame on the first start and on later ones, its whole track.

Each start is a process of its own, told from before Python begins; the recording is there already, and the first start
has no kernels. Wall-clock times, so other programs on the machine count.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.commands import used
from benchmarks.figures import LEFT_OUT, amount, figure, quick, recording
from benchmarks.timing import took

_TAKE = """
import sys
from pathlib import Path
from kinefit.readers import assets
assets.sample_recording = lambda progress=None: Path(sys.argv[1])
take = assets.write_sample_take(Path(sys.argv[2]))
if len(sys.argv) > 3:
    take.write_text(take.read_text().replace("[[keypoints]]", f"[[keypoints]]\\nframes = [0, {sys.argv[3]}]"))
"""

_FIRST = """
import os, sys, time
def told(what, done, total):
    if what == "frames" and done:
        print(time.time(), flush=True)
        os._exit(0)
from kinefit import track_take
track_take(sys.argv[1], progress=told)
"""


def run() -> None:
    """Print the times, and the memory of the whole track."""
    folder = recording("video_balancing_4cam")
    names = {"start_first": "<= 25", "start_later": "<= 1.5", "track_trial": "<= 12"}
    with tempfile.TemporaryDirectory() as work:
        take = Path(work) / "take"
        subprocess.run([sys.executable, "-c", _TAKE, str(folder), str(take), *amount([], ["25"])], check=True)
        kernels = os.environ | ({} if quick() else {"KINEFIT_CACHE": str(Path(work) / "kernels")})
        first = None if quick() else _first(take, kernels)
        figure("start_first", first, "s", names["start_first"], LEFT_OUT)
        figure("start_later", min(_first(take, kernels) for _ in range(amount(3, 1))), "s", names["start_later"])
        words = ["track", take, "--out", Path(work) / "out"]
        if not quick():  # also what only the writing of results needs is compiled
            used(*words, env=kernels)
        runs = [_whole(words, kernels) for _ in range(amount(2, 1))]
        figure("track_trial", min(seconds for seconds, _ in runs), "s", names["track_trial"])
        figure("track_trial_memory", max(memory for _, memory in runs), "MB", "<= 700")


def _whole(words: list[object], environment: dict[str, str]) -> tuple[float, float]:
    """[s] that a command takes, and [MB] of memory at most."""
    (_, memory), seconds = took(lambda: used(*words, env=environment), clock=time.perf_counter)
    return seconds, memory


def _first(take: Path, environment: dict[str, str]) -> float:
    """[s] from before Python begins to the first fitted frame."""
    began = time.time()
    command = [sys.executable, "-c", _FIRST, str(take / "take.toml")]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return float(done.stdout.split()[-1]) - began
