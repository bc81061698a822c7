"""A recorded take as a source: at its own speed, or as fast as the session takes the steps."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

from kinefit.errors import KinefitError
from kinefit.live.inbox import Arrived, Inbox
from kinefit.observations import Keypoints
from kinefit.tracking.recording import Recording

REPLAY = "replay"
"""Name of the sensor that stands for all sensors of a replayed take."""


class Replay:
    """Source of the steps of a recording, each with the frames of all sensors.

    Parameters
    ----------
    recording : Recording of all sensors but the keypoints' detectors
    keypoints : records of all people in view, of as many frames as the recording has steps
    speed : float, 1 for the recording's own; 0: as fast as the session takes the steps, without drops
    """

    def __init__(self, recording: Recording, keypoints: Sequence[Keypoints], *, speed: float = 1.0) -> None:
        self.recording, self.keypoints, self.speed = recording, tuple(keypoints), speed
        self.sensors: tuple[str, ...] = (REPLAY,)
        self.patient = not speed
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, inbox: Inbox) -> None:
        """Start putting steps into the inbox."""
        self._thread = threading.Thread(target=self._run, args=(inbox,), daemon=True, name=REPLAY)
        self._thread.start()

    def stop(self) -> None:
        """Stop putting steps into the inbox."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def seen(self, step: int) -> list[Any]:
        """The frames of all sensors at a step."""
        own = [k.rows(slice(step, step + 1), float(k.times[step])) for k in self.keypoints]
        return [*self.recording.steps(step), *own]

    def _run(self, inbox: Inbox) -> None:
        error = None
        try:
            times, start = self.recording.times, time.monotonic()
            for step in range(len(times)):
                due = start + float(times[step] - times[0]) / self.speed if self.speed else start
                if self._stop.wait(max(due - time.monotonic(), 0.0)):
                    return
                if not inbox.put(
                    Arrived(REPLAY, float(times[step]), time.monotonic(), self.seen(step)), wait=not self.speed
                ):
                    return
        except KinefitError as raised:
            error = raised
        finally:
            inbox.end(REPLAY, error)
