"""Record the motion of a live session on disk.

Each step is written as a row of fixed size, so that memory does not grow; at the end the rows become a motion.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.errors import ExportError
from kinefit.exporters.motion_file import write_motion
from kinefit.live.packets import PosePacket
from kinefit.motion import Motion

_SPOOL = "poses.unfinished"


class MotionRecord:
    """A receiver that records poses, and writes them as a motion at the end.

    Dropped steps and pauses become untracked frames. A client's choice of another person restarts the record. If the
    body changed, the motion has the last body's lengths, for earlier poses, too.

    Parameters
    ----------
    folder : Path, created if missing
    rate : float [Hz]
    up : vertical axis
    name : of the motion

    Attributes
    ----------
    path : of the motion, written by `close`; None if the person was never found
    """

    def __init__(self, folder: Path, *, rate: float, up: str, name: str) -> None:
        self.folder, self.rate, self.up, self.name = Path(folder), rate, up, name
        self.path: Path | None = None
        self._body: Body | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = open(self.folder / _SPOOL, "wb")
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise ExportError(problem, file=self.folder, remedy="Give another folder with --out.") from error
        self._last: NDArray | None = None
        self._first = 0.0
        self._choice = self.dropped = 0

    def hello(self, body: Body, packet: bytes) -> None:
        """Set the body; one with other coordinates restarts the record."""
        if self._body is not None and body.tree.coordinates != self._body.tree.coordinates:
            self._restart()
        self._body = body

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Record a pose at the step of its time."""
        r = posed.result
        self.dropped = sum(posed.dropped.values())
        if posed.choice != self._choice:
            self._choice = posed.choice
            self._restart()
        if r is None or self._body is None:
            return
        row = np.concatenate([
            [posed.time], r.state.T_world_root.ravel(), r.state.angles, r.dof_std, r.joint_std.ravel(),
            [r.support], r.segment_quality,
        ])  # fmt: skip
        if self._last is None:
            self._first = posed.time
        else:
            ahead = round((posed.time - self._first) * self.rate) - round((self._last[0] - self._first) * self.rate)
            if ahead < 1:  # within the latest recorded step
                return
            for k in range(1, min(ahead, round(600.0 * self.rate))):
                gap = self._last.copy()
                gap[0] += k / self.rate
                count = len(r.dof_std) + r.joint_std.size
                unseen = 17 + len(r.state.angles)
                gap[unseen : unseen + count], gap[unseen + count :] = np.inf, 0.0
                self._write(gap)
        self._write(row)
        self._last = row

    def close(self) -> None:
        """Write the motion."""
        self._file.close()
        spool = self.folder / _SPOOL
        body = self._body
        if body is not None and self._last is not None:
            motion = _motion(np.fromfile(spool).reshape(-1, len(self._last)), body, self.rate, self.up, self.name)
            target = self.folder / "motion.npz"
            write_motion(motion, target)
            self.path = target
        spool.unlink(missing_ok=True)

    def _restart(self) -> None:
        self._file.seek(0)
        self._file.truncate()
        self._last = None

    def _write(self, row: NDArray) -> None:
        try:
            self._file.write(row.tobytes())
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise ExportError(problem, file=self.folder / _SPOOL, remedy="Free some space.") from error


def _motion(rows: NDArray, body: Body, rate: float, up: str, name: str) -> Motion:
    """Convert rows of `MotionRecord` to a motion with even times."""
    D, S = len(body.tree.coordinates), len(body.tree.segments)
    ends = np.cumsum([1, 16, D, 6 + D, 3 * S, 1, S])
    time, T, angles, dof_std, joint_std, quality, segment_quality = np.split(rows, ends[:-1], axis=1)
    F = len(rows)
    return Motion(
        body, rate, time[0, 0] + np.arange(F) / rate, T.reshape(F, 4, 4), angles, dof_std, joint_std.reshape(F, S, 3),
        quality[:, 0], segment_quality, up=up, name=name, provenance={"live": {"lost": int(np.sum(quality == 0.0))}},
    )  # fmt: skip
