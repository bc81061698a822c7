"""Checkpoints of a run: after a crash the next run resumes from the last one, to the same result bit for bit.

A folder holds a `FrameFile`, a table of the finished frames for users, and a lock. What is written is read back at
once and used, so an interrupted run computes with the same numbers as an uninterrupted one. Nothing is executed.

The file of a checkpoint: what is kept of every frame done, and after every few hundred the state of the tracker.

The next run reads it up to the last whole state. What comes after that is dropped, and so is all of a file that is
damaged before its first state, or of another take.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from kinefit._records import Codec, RecordFile
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError, FileError, KinefitError, ObservationError
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.smoothing.spool import CODEC, Store
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.kinds import SensorKind, plugins_of
from kinefit.sensors.base import Measurement, Sensor
from kinefit.sensors.points.keypoints import Layout, Stream

FORMAT = b"kinefit frames 3\n"
"""First line of the file. The second is a digest of all that the result depends on."""

FRAME, STATE = range(2)  # tags of the records of a frame and of the tracker's state
_LAYOUT = "layout "  # begins the names of layouts, their streams as JSON follow


class FrameFile(Store):
    """Records of frames in a file that outlives the process.

    Parameters
    ----------
    path : Path; what another run left there is overwritten where it is of no use
    key : of all that the result depends on
    classes : of records, besides those of kinefit

    Attributes
    ----------
    at : int, step before which the last state was kept; None where there is none
    state : of the tracker then
    steps : numbers of the steps done until then, in their order
    places : the bytes at which the records of these steps begin
    problem : what is wrong with what an earlier run left, "" for nothing
    """

    def __init__(self, path: Path, key: str, classes: Iterable[type] = ()) -> None:
        head = FORMAT + hashlib.sha256(key.encode()).hexdigest().encode() + b"\n"
        self._file = open(path, "r+b" if path.exists() else "w+b")
        seal = hashlib.sha256(head).digest()
        codec = Codec(list(dict.fromkeys([*CODEC.classes, *classes])))
        super().__init__(records=RecordFile(self._file, seal, start=len(head), name=path), codec=codec)
        self._path, self._known = path, dict[str, Any]()
        self._layout_of: Callable[[Sequence[Stream]], Layout]
        self.at: int | None = None
        self.state: Any = None
        self.steps: list[int] = []
        self.places = array("q")
        self.problem = self._read(head)

    def _read(self, head: bytes) -> str:
        """Find the frames up to the last whole state and cut off what comes after; what is wrong with that, or ""."""
        found = self._file.read(len(head))
        if found != head:
            self._file.seek(0)
            self._file.truncate()
            self._file.write(head)
            if re.fullmatch(FORMAT + rb"[0-9a-f]{64}\n", found):
                return "belongs to another take, changed files, other options or another version of kinefit"
            return "is damaged or has another format" if found else ""
        records, whole, last = self._records, self._records.start, b""
        at, count, steps, places = 0, 0, list[int](), array("q")
        for place, tag, number, data in records.scan():
            if tag == STATE:
                at, count, whole, last = number, len(steps), records.end, data
            elif tag == FRAME:
                places.append(place)
                steps.append(number)
        end, size = records.end, self._path.stat().st_size
        try:
            self.state = self._codec.decode(last) if last else None
        except FileError:
            whole, last = records.start, b""
        records.cut(whole)
        if not last:
            return "is damaged, or ends before its first state" if size > whole else ""
        self.at, self.steps, self.places = at, steps[:count], places[:count]
        return f"is damaged or cut off at byte {end}" if size > end else ""

    def keep(self, at: int, state: Any) -> Any:
        """Write the state before a step, and have it and all frames on the disk; returns it as it will be read back.

        Raises
        ------
        ExportError
            It cannot be written.
        ObservationError
            A sensor's state has what is neither a number, a text, an array nor a record that is stored.
        """
        try:
            data = self._codec.encode(state)
        except TypeError as error:
            names = (name for name, (_, learnt) in state["sensors"]["sensors"].items() if not self._can_store(learnt))
            problem = f"sensor '{next(names, '?')}' has a state that cannot be stored: {error}"
            remedy = "Keep numbers, texts, arrays and lists of them in `state_attributes`, or leave out the checkpoint."
            raise ObservationError(problem, remedy=remedy) from error
        try:
            self._records.append(data, STATE, at)
            self._records.flush()
        except OSError as error:
            raise self._full(error) from error
        self.at = at
        return self._codec.decode(data)

    def _can_store(self, state: Any) -> bool:
        try:
            self._codec.encode(state)
        except TypeError:
            return False
        return True

    def name(self, **objects: Any) -> None:
        """Names by which records refer to objects that every run has of its own."""
        self._known |= objects

    def name_sensors(self, sensors: Iterable[Sensor]) -> None:
        """The same of sensors, by their own names."""
        self._known |= {f"sensor {sensor.name}": sensor for sensor in sensors}

    def name_layouts(self, layout_of: Callable[[Sequence[Stream]], Layout]) -> None:
        """The same of all other layouts of keypoints, by their streams: steps differ in which cameras saw something."""
        self._layout_of = layout_of

    def close(self) -> None:
        """Close the file; its records cannot be read any more."""
        self._file.close()

    def _full(self, error: OSError) -> ExportError:
        remedy = "Free some space, or give another folder with --out."
        return ExportError(f"cannot be written ({error.strerror})", file=self._path, remedy=remedy)

    def _refer(self, thing: Any) -> str:
        if isinstance(thing, Sensor):
            self._known.setdefault(f"sensor {thing.name}", thing)
            return f"sensor {thing.name}"
        for name, known in self._known.items():
            if known is thing:
                return name
        if isinstance(thing, Layout):
            return _LAYOUT + json.dumps(thing.streams)
        problem = f"a checkpoint cannot store a custom {type(thing).__name__}"
        remedy = "Name its class in `records` of its SensorKind, or leave out checkpoint."
        raise ObservationError(problem, remedy=remedy)

    def _resolve(self, reference: int | str) -> Any:
        if (name := str(reference)).startswith(_LAYOUT):
            streams = json.loads(name.removeprefix(_LAYOUT))
            return self._layout_of([(camera, points, tuple(names)) for camera, points, names in streams])
        return self._known[name]


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
