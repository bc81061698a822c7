"""What waits to be processed: of each sensor the newest frame alone, so that nothing queues and latency is bounded."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from kinefit.errors import KinefitError

SILENT = 1.0
"""[s] without a frame after which nobody waits for a sensor, and it is told as silent."""


@dataclass(frozen=True, eq=False)
class Arrived:
    """Something that one sensor saw.

    Parameters
    ----------
    sensor : str
    time : float [s] when it was seen, on the session's clock
    at : float [s] when it arrived, of `time.monotonic`
    seen : frames for the tracker, records of keypoints of one frame, or an image (H, W, 3) uint8 RGB
    """

    sensor: str
    time: float
    at: float
    seen: Any


class Inbox:
    """One slot a sensor: what nobody took before the next frame came is dropped, and counted.

    Parameters
    ----------
    sensors : names of all that will come
    patience : float [s] how long the frames of other sensors are waited for once one has come: half a frame

    Attributes
    ----------
    dropped : {sensor: int}, frames that were replaced before they were taken
    came : {sensor: int}, frames that arrived
    """

    def __init__(self, sensors: Sequence[str], *, patience: float) -> None:
        self.patience = patience
        self.dropped, self.came = dict.fromkeys(sensors, 0), dict.fromkeys(sensors, 0)
        self._slots: dict[str, Arrived] = {}
        self._last: dict[str, float] = dict.fromkeys(sensors, -float("inf"))
        self._open = set(sensors)  # that may still bring something
        self._error: KinefitError | None = None
        self._changed = threading.Condition()

    def put(self, one: Arrived, *, wait: bool = False) -> bool:
        """Bring a frame; `wait` until the slot is free instead of dropping what is in it. False when all is over."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: one.sensor not in self._slots or one.sensor not in self._open)
            if one.sensor not in self._open:
                return False
            if one.sensor in self._slots:
                self.dropped[one.sensor] += 1
            if not any(self.came.values()):  # to begin with, all are waited for
                self._last = dict.fromkeys(self._last, one.at)
            self._slots[one.sensor], self._last[one.sensor] = one, one.at
            self.came[one.sensor] += 1
            self._changed.notify_all()
            return True

    def lose(self, sensor: str) -> None:
        """Count a frame that came and was not brought."""
        with self._changed:
            self.came[sensor] += 1
            self.dropped[sensor] += 1

    def end(self, sensor: str, error: KinefitError | None = None) -> None:
        """Nothing more will come of a sensor; an error ends the session."""
        with self._changed:
            self._open.discard(sensor)
            self._error = self._error or error
            self._changed.notify_all()

    def close(self) -> None:
        """Nobody takes anything more: those who wait to bring something go on."""
        with self._changed:
            self._open.clear()
            self._slots.clear()
            self._changed.notify_all()

    @property
    def over(self) -> bool:
        """Whether nothing is there and nothing more can come."""
        with self._changed:
            return not (self._open or self._slots or self._error)

    def silent(self) -> list[str]:
        """Sensors that may still bring something and have brought nothing for a while."""
        now = time.monotonic()
        with self._changed:
            return [name for name in self._last if name in self._open and now - self._last[name] > SILENT]

    def take(self, timeout: float) -> list[Arrived]:
        """What has come: when all sensors that are not silent have brought something, or patience is over.

        Raises
        ------
        KinefitError
            With which a sensor ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._slots or not self._open or self._error, max(timeout, 0.0))
            if self._error is not None:
                raise self._error
            if self._slots:
                first = min(one.at for one in self._slots.values())
                until = max(first + self.patience, time.monotonic())
                while self._awaited() and (left := until - time.monotonic()) > 0.0:
                    self._changed.wait(left)
            out = list(self._slots.values())
            self._slots.clear()
            self._changed.notify_all()
            return out

    def _awaited(self) -> bool:
        now = time.monotonic()
        long = max(SILENT, self.patience)
        lively = (name for name in self._open if now - self._last[name] <= long)
        return any(name not in self._slots for name in lively)
