"""Inbox of a session: the newest frame of each sensor only, so that the latency is bounded."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from kinefit.errors import KinefitError

SILENT_AFTER_S = 1.0
"""Time without a frame after which a sensor is reported as silent, and the session no longer waits for it."""


@dataclass(frozen=True, eq=False)
class Arrived:
    """A frame of one sensor.

    Parameters
    ----------
    sensor : str
    time : float [s] of the measurement, on the session's clock
    at : float [s] of the arrival, on the clock `time.monotonic`
    seen : frames for the tracker, records of keypoints of one frame, or an image (H, W, 3) uint8 RGB
    """

    sensor: str
    time: float
    at: float
    seen: Any


class Inbox:
    """One slot for each sensor: a new frame replaces one that was not taken, which is counted as dropped.

    Parameters
    ----------
    sensors : names of all sensors
    patience : float [s] to wait for the other sensors after the first frame: half a frame interval

    Attributes
    ----------
    dropped : {sensor: int}, frames replaced before they were taken
    came : {sensor: int}, arrived frames
    """

    def __init__(self, sensors: Sequence[str], *, patience: float) -> None:
        self.patience = patience
        self.dropped, self.came = dict.fromkeys(sensors, 0), dict.fromkeys(sensors, 0)
        self._slots: dict[str, Arrived] = {}
        self._last: dict[str, float] = dict.fromkeys(sensors, -float("inf"))
        self._open = set(sensors)  # sensors that have not ended
        self._error: KinefitError | None = None
        self._changed = threading.Condition()

    def put(self, frame: Arrived, *, wait: bool = False) -> bool:
        """Put a frame into its slot; `wait` for a free slot instead of replacing. False if the inbox is closed."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: frame.sensor not in self._slots or frame.sensor not in self._open)
            if frame.sensor not in self._open:
                return False
            if frame.sensor in self._slots:
                self.dropped[frame.sensor] += 1
            if not any(self.came.values()):  # at the start, wait for all sensors
                self._last = dict.fromkeys(self._last, frame.at)
            self._slots[frame.sensor], self._last[frame.sensor] = frame, frame.at
            self.came[frame.sensor] += 1
            self._changed.notify_all()
            return True

    def lose(self, sensor: str) -> None:
        """Count a frame that arrived and was discarded by its source."""
        with self._changed:
            self.came[sensor] += 1
            self.dropped[sensor] += 1

    def end(self, sensor: str, error: KinefitError | None = None) -> None:
        """End a sensor; an error ends the session."""
        with self._changed:
            self._open.discard(sensor)
            self._error = self._error or error
            self._changed.notify_all()

    def close(self) -> None:
        """Close the inbox, and release the sources that wait for a free slot."""
        with self._changed:
            self._open.clear()
            self._slots.clear()
            self._changed.notify_all()

    @property
    def over(self) -> bool:
        """Whether the inbox is empty and all sensors have ended."""
        with self._changed:
            return not (self._open or self._slots or self._error)

    def silent(self) -> list[str]:
        """Sensors that have not ended, without a frame for `SILENT_AFTER_S`."""
        now = time.monotonic()
        with self._changed:
            return [name for name in self._last if name in self._open and now - self._last[name] > SILENT_AFTER_S]

    def take(self, timeout: float) -> list[Arrived]:
        """Take all frames, once each active sensor has one, or after `patience`; `timeout` [s] for the first.

        Raises
        ------
        KinefitError
            The error with which a sensor ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._slots or not self._open or self._error, max(timeout, 0.0))
            if self._error is not None:
                raise self._error
            if self._slots:
                first = min(frame.at for frame in self._slots.values())
                until = max(first + self.patience, time.monotonic())
                while self._awaited() and (left := until - time.monotonic()) > 0.0:
                    self._changed.wait(left)
            out = list(self._slots.values())
            self._slots.clear()
            self._changed.notify_all()
            return out

    def _awaited(self) -> bool:
        now = time.monotonic()
        longest = max(SILENT_AFTER_S, self.patience)
        active = (name for name in self._open if now - self._last[name] <= longest)
        return any(name not in self._slots for name in active)
