"""The file of a checkpoint: what is kept of every frame done, and after every few hundred the state of the tracker.

The next run reads it up to the last whole state. What comes after that is dropped, and so is all of a file that is
damaged before its first state, or of another take.
"""

from __future__ import annotations

import hashlib
import json
import re
from array import array
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from kinefit._records import Codec, RecordFile
from kinefit.errors import ExportError, FileError, ObservationError
from kinefit.fitting.smoothing.spool import CODEC, Store
from kinefit.sensors.base import Sensor
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
