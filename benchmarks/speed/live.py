"""Live sessions on the balancing trial, replayed at 30 frames a second: latency, an hour's memory and drift.

Latency is from the arrival of a step until all receivers have its pose: a client of the page, an avatar, a file, the
motion on disk. The trial is gone through forwards and backwards, so that the person never leaps; settings are defaults.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from benchmarks.figures import amount, data, figure, recording
from benchmarks.scenes.balancing import TRIAL, trial_text
from benchmarks.scenes.simulated import to_and_fro
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation.recordings import warm_keypoints
from kinefit.studio.live.cameras import Arrived
from kinefit.studio.live.receivers.websocket import JsonLines, Vmc, WebSockets
from kinefit.studio.live.record import MotionRecord
from kinefit.studio.live.session import LiveSession
from kinefit.studio.live.take import live_session

RATE = 30.0
_CLIENT = (
    "import sys\nfrom websockets.sync.client import connect\n"
    "with connect(sys.argv[1]) as s:\n    for _ in s: pass\n"
)


def resident_mb() -> float:
    """Resident set of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


class Loop:
    """The trial's keypoints over and over, forwards and backwards, at a rate; 0 as fast as they are taken."""

    sensors = ("loop",)

    def __init__(self, keypoints, frames, rate):
        self.keypoints, self.frames, self.rate, self.patient = keypoints, frames, rate, not rate
        self.over = threading.Event()

    def start(self, inbox):
        self.thread = threading.Thread(target=self.run, args=(inbox,), daemon=True)
        self.thread.start()

    def stop(self):
        self.over.set()
        self.thread.join()

    def run(self, inbox):
        begin = time.monotonic()
        for k, step in enumerate(to_and_fro(len(self.keypoints[0]), self.frames).tolist()):
            if self.over.wait(max(begin + k / self.rate - time.monotonic(), 0.0) if self.rate else 0.0):
                break
            seen = [r.rows(slice(step, step + 1), k / RATE) for r in self.keypoints]
            inbox.put(Arrived("loop", k / RATE, time.monotonic(), seen), wait=self.patient)
        inbox.end("loop")


class Watch:
    """Memory over the session, and where the joints were in each round."""

    def __init__(self, period, after):
        self.period, self.after, self.memory, self.rounds = period, after, [], []

    def hello(self, body, packet):
        pass

    def pose(self, posed, packet):
        if posed.number >= self.after and posed.number % amount(1000, 200) == 0:
            self.memory.append(resident_mb())
        if posed.number % self.period == 0 and posed.result is not None:
            self.rounds.append(posed.Ts_world_segment[:, :3, 3])

    def close(self):
        pass


def write_take(folder, *, keypoints):
    """The trial as a take, with or without a detector's keypoints; its path."""
    head = 'name = "balancing"\nrate = 60.0\n'
    text = trial_text(data(TRIAL), detector="mediapipe" if keypoints else "", head=head, keypoints="sigma = 10.0\n")
    path = Path(folder) / "take.toml"
    path.write_text(text)
    return path


def followed(folder, frames, rate, more=()):
    """A session of the trial's keypoints with all receivers, and a client of the page in another process."""
    path = write_take(folder, keypoints=True)
    whole = live_session(read_take(path))
    keypoints = load_observations(read_take(path)).keypoints
    served = WebSockets(0)
    url = f"ws://127.0.0.1:{served.port}"
    client = subprocess.Popen([sys.executable, "-c", _CLIENT, url], stderr=subprocess.DEVNULL)
    while not served.receivers:
        time.sleep(0.05)
    out = Path(folder) / "out"
    receivers = [
        JsonLines(Path(folder) / "poses.jsonl"), Vmc("127.0.0.1", 39539, up="z"),
        MotionRecord(out, rate=RATE, up="z", name="balancing"), served, *more,
    ]  # fmt: skip
    session = LiveSession(whole.tracker, [Loop(keypoints, frames, rate)], receivers, size=whole.size)
    warm_keypoints()
    session.run()
    client.kill()
    return session


def run() -> None:
    recording(TRIAL)
    with tempfile.TemporaryDirectory() as folder:
        session = followed(folder, amount(1200, 60), RATE)
        ms = 1e3 * np.array(session.latencies)
        print(f"keypoints: median {np.median(ms):.2f} ms, largest {ms.max():.1f} ms of {len(ms)} steps")
        figure("live_keypoints_p99", float(np.quantile(ms, 0.99)), "ms", "<= 5")
        figure("live_uncounted", _uncounted(session), "frames", "== 0")
    videos()
    frames = amount(108_000, 450)
    with tempfile.TemporaryDirectory() as folder:
        period = 198
        watch = Watch(period, amount(10_000, 200))
        began = time.perf_counter()
        session = followed(folder, frames, 0.0, [watch])
        print(f"{session.processed} frames in {time.perf_counter() - began:.0f} s")
        growth = max(watch.memory) - watch.memory[0]
        figure("live_hour_growth", growth, "MB", "<= 5")
        settled = watch.rounds[len(watch.rounds) // 2 :]
        figure("live_hour_drift", 1e3 * float(np.abs(settled[-1] - settled[0]).max()), "mm", "<= 0.1")
        figure("live_hour_uncounted", _uncounted(session), "frames", "== 0")


def videos() -> None:
    """The four videos at 30 frames a second through the built-in detector."""
    with tempfile.TemporaryDirectory() as folder:
        session = live_session(read_take(write_take(folder, keypoints=False)), speed=RATE / 60.0)
        warm_keypoints()
        times = []
        session.receivers = (_Times(times),)
        session.run()
        found = [(t, late) for t, late in times if t - times[0][0] > 1.0]  # the first look is at the whole image
        if len(found) < 3:
            figure("live_detector_p99", None, "ms", "<= 120", "nobody followed for more than a second")
            return
        when, late = np.array(found).T
        dropped, came = sum(session.inbox.dropped.values()), sum(session.inbox.came.values())
        print(f"detector: median {1e3 * np.median(late):.0f} ms; {dropped} of {came} images dropped and counted")
        figure("live_detector_p99", 1e3 * float(np.quantile(late, 0.99)), "ms", "<= 120")
        figure("live_detector_rate", (len(when) - 1) / float(when[-1] - when[0]), "Hz", ">= 15")


class _Times:
    def __init__(self, times):
        self.times = times

    def hello(self, body, packet):
        pass

    def pose(self, posed, packet):
        if posed.result is not None:
            self.times.append((time.monotonic(), posed.latency))

    def close(self):
        pass


def _uncounted(session) -> float:
    came, dropped = sum(session.inbox.came.values()), sum(session.inbox.dropped.values())
    return float(came - dropped - session.processed)
