"""Checkpoints of a run: after a crash the next run resumes from the last one, to the same result bit for bit.

A folder holds a `FrameFile`, a table of the finished frames for users, and a lock. What is written is read back at
once and used, so an interrupted run computes with the same numbers as an uninterrupted one. Nothing is executed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError, KinefitError
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.tracking.checkpoints.frame_file import FrameFile
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.kinds import SensorKind, plugins_of
from kinefit.sensors.base import Measurement

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_FRAMES, _ROWS, _LOCK = "frames.kinefit", "so-far.csv", "lock"  # the files of a folder: no other is touched


class Checkpoint:
    """A folder of unfinished work; used as a context, within which no other process works in it.

    Parameters
    ----------
    folder : Path, made where it is not there; files in it that are not of a checkpoint stay as they are
    key : of all that the result depends on, see `key_of`
    restart : forget what an earlier run left
    kinds : of sensors of the take, whose measurements are stored, too

    Attributes
    ----------
    packages : whose sensors it stores
    rows : Path of the table of the frames done
    """

    def __init__(
        self, folder: Path, key: str, *, restart: bool = False, kinds: Sequence[SensorKind] = ()
    ) -> None:
        self.folder, self._key, self._restart = Path(folder), key, restart
        self.packages = {"kinefit", *(kind.plugin.package for kind in kinds if kind.plugin is not None)}
        self._classes = _record_classes(kinds)
        self.rows = self.folder / _ROWS
        self._lock: IO[bytes] | None = None
        self._frames: FrameFile | None = None
        self._found: int | None = None

    @property
    def frames(self) -> FrameFile:
        """Records of the frames done.

        Raises
        ------
        ExportError
            The checkpoint was not entered.
        """
        if self._frames is None:
            remedy = "Use it inside `with Checkpoint(...) as checkpoint:`."
            raise ExportError("the checkpoint is not open", file=self.folder, remedy=remedy)
        return self._frames

    @property
    def resumed(self) -> bool:
        """Whether an earlier run left frames that this one goes on with."""
        return self._found is not None

    def __enter__(self) -> Checkpoint:
        """Lock the folder and read what an earlier run left.

        Raises
        ------
        ExportError
            Another process works there, the folder is another user's, or cannot be written.
        """
        self._made = not self.folder.parent.exists()
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = open(self.folder / _LOCK, "ab")
            self._refuse_others(self._lock)
            if self._restart:
                self.clear()
            self._frames = FrameFile(self.folder / _FRAMES, self._key, self._classes)
            self._remove_rows()
        except OSError as error:
            self.close()
            problem = f"cannot be written ({error.strerror})"
            raise ExportError(problem, file=self.folder, remedy="Give another folder with --out.") from error
        except ExportError:
            self.close()
            raise
        self._found = self._frames.at
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        comes_again = isinstance(error, KinefitError) and not isinstance(error, ExportError)
        nothing = self.frames.at is None
        self.close()
        if comes_again or nothing:
            self.remove()

    def _refuse_others(self, lock: IO[bytes]) -> None:
        info = self.folder.stat()
        if hasattr(os, "geteuid") and (info.st_uid != os.geteuid() or info.st_mode & 0o022):
            raise ExportError("other users can write to this folder", file=self.folder, remedy="Remove it.")
        if fcntl is not None:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                remedy = "Wait until it ends, or give another folder with --out."
                raise ExportError("another run uses this folder", file=self.folder, remedy=remedy) from error

    def said(self) -> list[str]:
        """Sentences for the user: what is resumed, what is computed again, what is left as it is."""
        out, problem, file = [], self.frames.problem, self.folder / _FRAMES
        if self.resumed:
            left = f"the run in {self.folder} at frame {self._found}"
            out.append(f"continuing {left}; --restart tracks all frames again")
        if problem:
            again = f"frames from {self._found} on are" if self.resumed else "all frames are"
            out.append(f"{file} {problem}: {again} tracked again")
        others = sorted(p.name for p in self.folder.iterdir() if p.name not in (_FRAMES, _ROWS, _LOCK))
        if others:
            out.append(f"{self.folder} has files that kinefit did not write and does not change: {', '.join(others)}")
        return out

    def close(self) -> None:
        """Release the lock."""
        for file in (self._frames, self._lock):
            if file is not None:
                with suppress(OSError):  # of a full disk, which was reported before
                    file.close()

    def clear(self) -> None:
        """Remove the frames and the table, and no other file."""
        (self.folder / _FRAMES).unlink(missing_ok=True)
        self._remove_rows()

    def _remove_rows(self) -> None:
        """Remove the table; ExportError if its name is not a file."""
        if not self.rows.exists():
            return
        with open(self.rows, "rb") as file:
            if not BEGIN.startswith(file.read(len(BEGIN))):
                raise ExportError("a file of this name is in the way", file=self.rows, remedy="Move or rename it.")
        self.rows.unlink()

    def remove(self) -> None:
        """Remove the files of a checkpoint, and the folder where nothing else is in it."""
        self.close()
        with suppress(OSError, ExportError):
            self.clear()
        with suppress(OSError):
            lock = self.folder / _LOCK
            if not lock.stat().st_size:
                lock.unlink()
            self.folder.rmdir()
            if self._made:
                self.folder.parent.rmdir()  # of results, if there are none


def _record_classes(kinds: Iterable[SensorKind]) -> list[type]:
    """Classes of records of plug-ins: all their measurements, in the order of their names, and what they list."""
    packages = {kind.plugin.package for kind in kinds if kind.plugin is not None}
    found, queue = set[type](), list[type]([Measurement])
    while queue:
        own: list[type] = queue.pop().__subclasses__()
        found |= {one for one in own if one.__module__.partition(".")[0] in packages}
        queue += own
    listed = {one for kind in kinds for one in kind.records}
    return sorted(found | listed, key=lambda one: (one.__module__, one.__qualname__))


def key_of(take: Take, **options: Any) -> str:
    """Digest of a take, of sizes and modification times of its files, of options and of kinefit's own code."""
    digest = hashlib.sha256(repr((take, sorted(options.items()), np.__version__)).encode())
    digest.update(code_digest())
    for plugin in plugins_of(take):
        digest.update(plugin.code_digest)
    takes = [take] if take.subject is None else [take, read_take(take.subject)]
    paths = set().union(*(_paths(one) | {Path(one.body)} for one in takes)) - {take.path}
    for path in sorted(paths, key=str):
        for one in sorted(path.iterdir()) if path.is_dir() else [path]:
            with suppress(OSError):
                info = one.stat()
                digest.update(f"{one!r} {info.st_size} {info.st_mtime_ns}".encode())
    return digest.hexdigest()


@cache
def code_digest() -> bytes:
    """Of kinefit's own code, as it was when this process first asked."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parents[2].rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.digest()


def _paths(thing: Any) -> set[Path]:
    """All paths in a record."""
    if isinstance(thing, Path):
        return {thing}
    if isinstance(thing, str | np.ndarray):
        return set()
    if isinstance(thing, Mapping):
        thing = tuple(thing.values())
    if not isinstance(thing, Sequence):
        names = [*getattr(thing, "__struct_fields__", ()), *getattr(thing, "__dataclass_fields__", ())]
        thing = tuple(getattr(thing, name) for name in names)
    return set().union(*(_paths(one) for one in thing))


class TrackingInterrupted(KeyboardInterrupt):
    """Ctrl-C while frames were tracked; finished frames are kept.

    Parameters
    ----------
    motion : Motion of the frames done, from the first one on.
    total : int, how many frames there are.
    """

    def __init__(self, motion: Motion, total: int) -> None:
        super().__init__(f"{len(motion)} of {total} frames are tracked")
        self.motion, self.total = motion, total


BEGIN = b"frame,time [s],quality,"
"""What such a file begins with."""


def append_rows(file: Path, body: Body, results: Iterable[tuple[int, FrameResult]]) -> None:
    """Add frames as the tracker left them, not smoothed: time, quality, the root's place, every coordinate.

    Parameters
    ----------
    file : begins with a header where it is not there yet
    results : step and result of each frame

    Raises
    ------
    ExportError
        It cannot be written.
    """
    units = ["m" if slides else "deg" for slides in body.tree.prismatic]
    factors = np.where(body.tree.prismatic, 1.0, np.degrees(1.0))
    names = [f"{name} [{unit}]" for name, unit in zip(body.tree.coordinates, units)]
    header = ["frame", "time [s]", "quality", *(f"root_t{axis} [m]" for axis in "xyz"), *names]
    try:
        with open(file, "a", encoding="utf-8") as out:
            if not out.tell():
                out.write(",".join(header) + "\n")
            for step, r in results:
                values = [r.time, r.quality, *r.state.T_world_root[:3, 3], *(factors * r.state.angles)]
                out.write(",".join([str(step), *(f"{value:.5f}" for value in values)]) + "\n")
    except OSError as error:
        remedy = "Free some space, or give another folder with --out."
        raise ExportError(f"cannot be written ({error.strerror})", file=file, remedy=remedy) from error
