"""What is kept of a live session: keypoints as they came, the poses, and the take file of both.

Each step is written as a row of fixed size, so that memory does not grow; at the end the rows become a motion.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular, write_text
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError
from kinefit.exporters.motion_file import write_detections, write_motion
from kinefit.geometry.camera import Rig
from kinefit.observations import MEDIAPIPE_33, Detections, KeypointFrame, LiftedFrame, by_record
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import Take
from kinefit.studio.live.packets import PosePacket

_TAKE_FILE = "take.toml"
_TAKE_HEAD = "# Recorded by kinefit live: kinefit track fits the whole session."
_K = len(MEDIAPIPE_33)
_ROW_LENGTH = 1 + 2 * _K + _K + 3 * _K  # time, pixels, confidence, lifted
_MAX_IMAGE_GAP = 1.5  # frames between two images, up to which a step between them is interpolated
_REMEDY = "Free some space, or give another folder with --out."


@contextmanager
def written(file: Path, remedy: str) -> Iterator[None]:
    """What the system refuses within, as an ExportError of this file with its remedy."""
    try:
        yield
    except OSError as error:
        raise ExportError(f"cannot be written ({error.strerror})", file=file, remedy=remedy) from error


class SeenRecord:
    """Record of the tracked person's keypoints; at the end it writes a take for `kinefit track`.

    Cameras of a live session are not synchronised. In the take each has a frame at every step of one rate, interpolated
    linearly between two of its images that are at most a frame and a half apart.

    Parameters
    ----------
    folder : Path, created if missing
    take : of the session
    rig : Rig
    rate : float [Hz] of the steps
    alone : whether the pose of the only camera is an assumption: then the take has no calibration

    Attributes
    ----------
    path : of the take file, written by `close`; None without detections
    """

    def __init__(self, folder: Path, take: Take, rig: Rig, *, rate: float, alone: bool) -> None:
        self.folder, self.take, self.rig, self.rate, self.alone = Path(folder), take, rig, rate, alone
        self.path: Path | None = None
        self._files: dict[str, BinaryIO] = {}
        with written(self.folder, _REMEDY):
            self.folder.mkdir(parents=True, exist_ok=True)
            other = self.folder / _TAKE_FILE
            if other.exists() and not regular(other).read_text(errors="replace").startswith(_TAKE_HEAD):
                remedy = "Give another folder with --out."
                raise ExportError("the session would overwrite this take", file=other, remedy=remedy)

    def keep(self, frames: Sequence[Any]) -> None:
        """Record the person's keypoints of one step; raises ExportError if they cannot be written."""
        seen = by_record(frames)
        lifted = {f.sensor: f.x for f in seen[LiftedFrame]}
        for f in seen[KeypointFrame]:
            if f.names == MEDIAPIPE_33:
                x = lifted.get(f.sensor, np.full((_K, 3), np.nan))
                row = np.concatenate([[f.time], f.uv.ravel(), f.confidence, x.ravel()])
                with written(self.folder, _REMEDY):
                    if f.sensor not in self._files:
                        self._files[f.sensor] = open(self._spool(f.sensor), "wb")
                    self._files[f.sensor].write(row.tobytes())

    def restart(self) -> None:
        """Discard what is recorded, detections of another person."""
        for name, file in self._files.items():
            file.close()
            self._spool(name).unlink()
        self._files = {}

    def close(self) -> None:
        """Write detections, calibration and take file."""
        for file in self._files.values():
            file.close()
        rows = {name: np.fromfile(self._spool(name)).reshape(-1, _ROW_LENGTH) for name in self._files}
        if rows:
            first = min(float(own[0, 0]) for own in rows.values())
            last = max(float(own[-1, 0]) for own in rows.values())
            grid = first + np.arange(int((last - first) * self.rate) + 1) / self.rate
            for name, own in rows.items():
                write_detections(self._detections(name, on_grid(own, grid, self.rate)), self.folder / f"{name}.npz")
            if not self.alone:
                write_calibration(self.rig, self.folder / "calibration.toml")
            self.path = self.folder / _TAKE_FILE
            write_text(self.path, self._text(list(rows)))
        for name in rows:
            self._spool(name).unlink(missing_ok=True)

    def _spool(self, camera: str) -> Path:
        return self.folder / f"{camera}.unfinished"

    def _detections(self, camera: str, rows: NDArray) -> Detections:
        F = len(rows)
        uv, confidence, lifted = np.split(rows[:, 1:], [2 * _K, 3 * _K], axis=1)
        unseen = np.isnan(uv).any(axis=1, keepdims=True)
        x = lifted.reshape(F, 1, _K, 3)
        return Detections(
            camera, self.rate, self.rig[camera].size, uv.reshape(F, 1, _K, 2),
            np.where(unseen, 0.0, confidence).reshape(F, 1, _K), np.zeros(0, np.uint32), np.zeros(F + 1, int),
            "a live session", None if np.isnan(x).all() else x,
        )  # fmt: skip

    def _text(self, cameras: Sequence[str]) -> str:
        """Text of the take file."""
        take, quoted = self.take, json.dumps
        lines = [_TAKE_HEAD, "", "[take]"]
        lines += [f"name = {quoted(take.name)}", f"rate = {self.rate:g}", f"up = {quoted(take.up)}"]
        lines += [f"body = {quoted(take.body)}"] + ([f"height = {take.height:g}"] if take.height else [])
        lines += [f"mass = {take.mass:g}"] if take.mass else []
        lines += [] if self.alone else ["", "[calibration]", 'file = "calibration.toml"']
        for name in cameras:
            entry = next(e for e in take.cameras if e.name == name)
            size = list(self.rig[name].size)
            lines += ["", "[[camera]]", f"name = {quoted(name)}", f"size = {size}"]
            if self.alone and entry.field_of_view is not None:
                lines += [f"field_of_view = {entry.field_of_view:g}"]
        for name in cameras:
            lines += ["", "[[keypoints]]", f"camera = {quoted(name)}", 'format = "detect"']
            lines += [f"file = {quoted(f'{name}.npz')}"]
        return "\n".join(lines) + "\n"


def on_grid(rows: NDArray, grid: NDArray, rate: float) -> NDArray:
    """Rows (N, M), times [s] in the first column, interpolated at times (F,) [s] between near rows; else NaN."""
    times = rows[:, 0]
    after = np.minimum(np.searchsorted(times, grid), len(times) - 1)
    before = np.maximum(after - 1, 0)
    low, high = times[before], times[after]
    s = np.clip((grid - low) / np.maximum(high - low, 1e-9), 0.0, 1.0)[:, None]
    out = (1.0 - s) * rows[before] + s * rows[after]
    inside = (high - low <= _MAX_IMAGE_GAP / rate) & (grid >= low - 1e-9) & (grid <= high + 1e-9)
    nearest = np.where(s[:, 0] < 0.5, before, after)
    exact = np.abs(times[nearest] - grid) <= 0.05 / rate  # alone, but in step
    out[exact & ~inside] = rows[nearest[exact & ~inside]]
    out[~(inside | exact)] = np.nan
    out[:, 0] = grid
    return out


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
        with written(self.folder, "Give another folder with --out."):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = open(self.folder / _SPOOL, "wb")
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
        with written(self.folder / _SPOOL, "Free some space."):
            self._file.write(row.tobytes())


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
