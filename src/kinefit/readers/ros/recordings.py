"""MCAP recordings of ROS 2 (extra `ros`): their topics, and messages of a topic by number.

A topic within a recording is written as a path: `session.mcap/front/depth/image_raw`. A folder that `ros2 bag record`
leaves stands for the one MCAP file in it.
"""

from __future__ import annotations

import io
import os
import struct
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, KinefitError, ObservationError, extra, located

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
_ENDING = ".mcap"
_MAX_CHUNK_BYTES = 110_000_000  # unpacked; recorders write 1 to 16 MB, or one image, which in 8K RGB takes 100 MB
_CHUNK_SIZE_OFFSET = 1 + 8 + 8 + 8  # [bytes] from a chunk's record to its unpacked size: opcode, length, two times
_CHUNK_HEAD_BYTES = 8 + 4 + 4 + 8 + 8 + 18  # size, checksum, length and name of the compression, length, frame's header
_MIN_STEP_S = 1e-6  # between images; as `Video`, which reads folders of images up to a million a second
_MAX_UNCHECKED_BYTES = 2**20  # of one read; larger requests are limited to the rest of the file


def inside(path: Path) -> tuple[Path, str | None] | None:
    """The recording that contains a path, and the topic (None if the path has none); None for other files.

    Raises
    ------
    FileError
        A recording in SQLite, or one that is split into several files.
    """
    for file in (path, *path.parents):
        found = _recording(file)
        if found is not None:
            topic = path.relative_to(file).as_posix()
            return found, None if topic == "." else f"/{topic}"
        if file.suffix.lower() == _ENDING:  # a missing recording
            return None
    return None


def _recording(path: Path) -> Path | None:
    ending = path.suffix.lower()
    if ending == _ENDING and path.is_file():
        return path
    if path.is_dir() and (path / "metadata.yaml").is_file():
        files = sorted(path.glob(f"*{_ENDING}"))
        if len(files) > 1:
            problem = f"a recording in {len(files)} files"
            remedy = f"Name one of them ({files[0].name}), or merge them: `mcap merge`."
            raise FileError(problem, file=path, remedy=remedy)
        if files:
            return files[0]
        path = next(iter(path.glob("*.db3")), path)
    if path.suffix.lower() == ".db3" and path.is_file():
        remedy = "Make an MCAP file of it: `ros2 bag convert`, or `mcap convert recording.db3 recording.mcap`."
        raise FileError("a recording of ROS 2 in SQLite, which is not read", file=path, remedy=remedy)
    return None


class Topics:
    """The topics of an open recording.

    Attributes
    ----------
    kinds : {topic: type of its messages}, of topics with readable messages

    Raises
    ------
    FileError
        A recording without an index.
    """

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        summary = reader.get_summary()
        if summary is None:
            problem = "it has no index: was the recording cut short?"
            raise FileError(problem, remedy="Run `mcap recover` on it.")
        self.kinds = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values() if c.schema_id}

    def of(self, *kinds: str) -> list[str]:
        """Topics of these types, sorted by name."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    def first(self, topic: str) -> Any:
        """The first message of a topic; None without one."""
        return next((message for *_, message in self._reader.iter_decoded_messages(topics=[topic])), None)

    def all(self, topic: str) -> Iterator[Any]:
        """All messages of a topic."""
        return (message for *_, message in self._reader.iter_decoded_messages(topics=[topic]))

    def chosen(self, topic: str | None, fitting: Mapping[str, Any] | list[str], what: str, name: str = "") -> str:
        """The requested topic; else the only fitting one, or the only fitting one with a part called `name`.

        Raises
        ------
        ObservationError
            No such topic, or no unique one.
        """
        listed = ", ".join(sorted(fitting))
        if topic is not None:
            if topic in fitting:
                return topic
            kind = self.kinds.get(topic)
            problem = f"no topic {topic}" if kind is None else f"{topic} ({kind}) has no {what}"
            problem += f"; topics with {what}: {listed or 'none'}"
            raise ObservationError(problem, remedy="Correct topic.")
        named = [t for t in fitting if name in t.split("/")] or list(fitting)
        if len(named) == 1:
            return named[0]
        if not named:
            have = ", ".join(sorted(self.kinds)) or "none"
            problem = f"no topic of it has {what}; its topics are {have}"
            raise ObservationError(problem, remedy="Record the camera's images.")
        problem = f"{len(named)} topics have {what}: {', '.join(sorted(named))}"
        raise ObservationError(problem, remedy="Write topic = ... in the table that names the file.")

    def begin(self) -> int:
        """[ns] time of the first image of any topic, by its header; 0 if headers have no time."""
        stamps = []
        for topic in self.of(IMAGE, COMPRESSED):
            for _, _, message in self._reader.iter_messages(topics=[topic]):
                stamps.append(stamp(message.data))
                break
        return min(stamps, default=0)

    def times(self, topic: str) -> tuple[NDArray, list[int]]:
        """Times (N,) [s] of a topic's images from the recording's first image on, and log times [ns].

        Times are those of the headers. If these do not increase, they are those of the log, and 0 is the topic's own
        first image.
        """
        stamps, logged = [], []
        for _, _, message in self._reader.iter_messages(topics=[topic]):
            stamps.append(stamp(message.data))
            logged.append(message.log_time)
        begin, by = self.begin(), np.array(stamps, np.int64)
        if not (begin > 0 and (np.diff(by) > 0).all()):
            by, begin = np.array(logged, np.int64), logged[0]
        return (by - begin) * 1e-9, logged


def median_rate(times: NDArray, topic: str) -> float:
    """Rate [Hz] of a topic's images, from the median step of their times (N,) [s].

    Raises
    ------
    ObservationError
        One image alone, or most of them at one time.
    """
    steps = np.diff(times)
    if not len(steps):
        raise ObservationError(f"only one image on the topic {topic}", remedy="Record it for longer.")
    step = float(np.median(steps))
    if step < _MIN_STEP_S:
        problem = f"a median step of {step:g} s between the images on the topic {topic}"
        raise ObservationError(problem, remedy="Record them with the times at which they were taken.")
    return 1.0 / step


class Messages:
    """Messages of a topic, by number: sequential access reads on, random access seeks.

    Parameters
    ----------
    path : of the recording
    topic : str
    logged : log time of each [ns]
    convert : what is made of each
    """

    def __init__(self, path: Path, topic: str, logged: list[int], convert: Callable[[Any], NDArray]) -> None:
        self._path, self._topic, self._logged, self._convert = path, topic, logged, convert
        self._open, self._next = ExitStack(), -1
        self._coming: Iterator[Any] = iter(())
        weakref.finalize(self, self._open.close)  # in a cycle Python may drop the file before what closes it

    def __call__(self, i: int) -> NDArray:
        """Message `i`, decoded and converted.

        Raises
        ------
        FileError
            It is missing or damaged.
        """
        if i != self._next:
            self._seek(i)
        try:
            *_, message = next(self._coming)
        except StopIteration:
            problem = "frame cannot be found again"
            raise FileError(problem, file=self._path, place=f"frame {i}", remedy="Copy it again.") from None
        except Exception as error:  # of damaged files libraries raise anything
            raise _damaged(error, self._path) from error
        self._next = i + 1
        with located(self._path, f"frame {i}"):
            return self._convert(message)

    def close(self) -> None:
        """Close the file; the next access opens it again."""
        self._open.close()
        self._next = -1

    def _seek(self, i: int) -> None:
        self.close()
        at = self._logged[i]
        reader = self._open.enter_context(reading(self._path))
        self._coming = iter(reader.iter_decoded_messages(topics=[self._topic], starting_at=at))
        for _ in range(i - self._logged.index(at)):  # of several messages with one log time
            next(self._coming, None)


@contextmanager
def reading(path: Path) -> Iterator[Any]:
    """A reader as a context manager; raises FileError for all errors of its library."""
    with extra("ros", "an MCAP recording needs the package mcap-ros2-support", FileError, file=path):
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    try:
        with located(path), _BoundedReader(io.FileIO(path)) as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            _check_chunks(reader, file)
            yield reader
    except KinefitError:
        raise
    except Exception as error:  # of damaged files libraries raise anything
        raise _damaged(error, path) from error


def _check_chunks(reader: Any, file: io.BufferedReader) -> None:
    """Raise FileError if a chunk unpacks to more than `_MAX_CHUNK_BYTES`, by its record and its Zstandard frame."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    summary = reader.get_summary()
    if summary is not None and summary.chunk_indexes:
        places = [index.chunk_start_offset + _CHUNK_SIZE_OFFSET for index in summary.chunk_indexes]
        heads = (file.read(_CHUNK_HEAD_BYTES) for place in places if file.seek(place))
    else:  # chunks without an index are read from the first to the last
        file.seek(0)
        records = StreamReader(file, emit_chunks=True).records
        heads = (
            struct.pack("<QII", r.uncompressed_size, 0, len(r.compression)) + r.compression.encode() + bytes(8) + r.data
            for r in records if isinstance(r, Chunk)
        )  # fmt: skip
    for head in heads:
        size, _, name_length = struct.unpack_from("<QII", head)
        size = max(size, _zstd_size(head[16 + name_length + 8 :]))
        if size > _MAX_CHUNK_BYTES:
            problem = f"a chunk of {size / 1e6:.0f} MB, more than {_MAX_CHUNK_BYTES / 1e6:.0f} MB"
            raise FileError(problem, remedy="Record with smaller chunks; copy it again if it is damaged.")


def _zstd_size(frame: bytes) -> int:
    """Bytes that a Zstandard frame (RFC 8878, 3.1.1) states to unpack to; 0 where it states none or is no frame."""
    if not frame.startswith(b"\x28\xb5\x2f\xfd") or len(frame) < 18:
        return 0
    code, alone, dictionary = frame[4] >> 6, frame[4] >> 5 & 1, frame[4] & 3
    start, length = 6 - alone + (0, 1, 2, 4)[dictionary], (alone, 2, 4, 8)[code]
    return int.from_bytes(frame[start : start + length], "little") + (256 if code == 1 else 0)


class _BoundedReader(io.BufferedReader):
    """A file whose reads are limited to its size: a damaged length would otherwise allocate memory."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _MAX_UNCHECKED_BYTES:
            size = min(size, max(os.fstat(self.fileno()).st_size - self.tell(), 0))
        return super().read(size)


def _damaged(error: Exception, path: Path) -> FileError:
    problem = f"no recording of ROS 2 that can be read ({type(error).__name__}: {error})"
    return FileError(problem, file=path, remedy="Copy it again; `mcap doctor` says what is wrong with it.")


def stamp(data: bytes) -> int:
    """Time [ns] in the header at the beginning of a CDR message."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 10**9 + nanoseconds
