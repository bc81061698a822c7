"""Files: TOML, tables and numpy archives are read within bounds of time and memory, and files are written whole."""

from __future__ import annotations

import csv
import errno
import os
import re
import tomllib
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from glob import escape
from os import PathLike
from pathlib import Path
from typing import IO, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ExportError, FileError, KinefitError, ObservationError, choices, printable

_Record = TypeVar("_Record")
_MIN_STEP_S = 1e-6  # between frames of a table; shorter or longer than its inverse, times are in another unit
_MAX_TOML_CHARACTERS = 4_000_000  # which tomllib reads in about 2 s; kinefit's own files have thousands
_DOTTED = re.compile(r"(?<![\w.-])(?:(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')[ \t]*+\.[ \t]*+){50}")
BACKSLASHES = "A backslash in double quotes begins a special character: use forward slashes."
"""What to do about C:\\Users in a TOML file."""


def with_slashes(path: str) -> str:
    """A path with forward slashes in place of backslashes, single or doubled, as every system reads it."""
    return re.sub(r"\\+", "/", path)


def no_column(missing: Iterable[str], names: Iterable[str] | None) -> str:
    """What to say of a table that lacks columns; `names` are those of its first line."""
    reason = f"no column {', '.join(missing)}"
    other = next((mark for mark in (";", "\t") if any(mark in name for name in names or ())), None)
    return reason if other is None else f"{reason}: its columns are separated by {other!r}, not by commas"


def read_table(
    path: Path, columns: Sequence[str], remedy: str, *, text: str = "", optional: Sequence[str] = ()
) -> tuple[list[str], NDArray]:
    """Columns of a CSV table with a line of names; columns that are not asked for are not read.

    Parameters
    ----------
    columns : of numbers, which the table must have
    remedy : of the errors
    text : name of a column of text; default: none is read
    optional : further columns of numbers; NaN where the table has none of this name, or a cell is empty

    Returns
    -------
    texts : (N,) of the column of text, without blanks around it; empty without such a column
    values : (N, C) numbers of `columns`, then of `optional`; row k is line k + 2 of the file

    Raises
    ------
    FileError
        No such table, a column that it lacks, or a number that is none, with its line.
    """
    texts, rows = list[str](), list[list[float]]()
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            table = csv.reader(file)
            names = [name.strip() for name in next(table, [])]
            missing = [name for name in ([text] if text else []) + list(columns) if name not in names]
            if missing:
                raise FileError(no_column(missing, names), file=path, remedy=remedy)
            at = [names.index(name) for name in columns]
            more = [names.index(name) if name in names else None for name in optional]
            for line, row in enumerate(table, 2):
                try:
                    cells = [np.nan if k is None or not row[k].strip() else float(row[k]) for k in more]
                    rows.append([float(row[k]) for k in at] + cells)
                    texts += [row[names.index(text)].strip()] if text else []
                except (ValueError, IndexError):
                    raise FileError("a cell is not a number", file=path, place=f"line {line}", remedy=remedy) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy=remedy) from None
    return texts, np.array(rows).reshape(-1, len(columns) + len(optional))


def rate_of(times: NDArray, path: Path, remedy: str) -> float:
    """Rate [Hz] of the frames of a table, from their sorted times (F,) [s]; ObservationError where there is none."""
    if len(times) < 2:
        raise ObservationError(f"points of {len(times)} times", file=path, remedy=remedy)
    if not _MIN_STEP_S < (step := float(np.median(np.diff(times)))) < 1 / _MIN_STEP_S:
        raise ObservationError(f"times {step:g} s apart", file=path, remedy="Give time_s in seconds.")
    return 1.0 / step


def repeated(names: Iterable[str]) -> list[str]:
    """Names that occur more than once, in order of appearance."""
    return [name for name, count in Counter(names).items() if count > 1]


def regular(path: str | os.PathLike[str]) -> Path:
    """The path, if reading there ends; a missing file and a folder are for the reader to report.

    Raises
    ------
    FileError
        A named pipe, a socket or a device, or a link to one: reading may wait for ever, or never end.
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        remedy = "Copy what it gives into a file, and name that."
        raise FileError("a pipe, socket or device, not a file", file=path, remedy=remedy)
    return Path(path)


def read_bytes(path: Path, most: int = -1) -> bytes:
    """All of a file, or its first bytes; FileError where it cannot be read, or is no regular file."""
    try:
        if regular(path).is_dir():
            raise FileError("is not a file", file=path, remedy="Check the path.")
        with path.open("rb") as file:
            return file.read(most)
    except FileNotFoundError as problem:
        raise FileError("no such file", file=path, remedy="Check the path.") from problem
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or str(problem)
        raise FileError(f"cannot be read ({reason})", file=path, remedy="Check the path.") from problem


def read_text(
    path: str | os.PathLike[str], what: str, *, remedy: str, error: type[KinefitError] = FileError,
    errors: str = "strict",
) -> str:  # fmt: skip
    """The text (UTF-8) of a file; `error` where it cannot be read, such as "cannot read the mesh (...)"."""
    try:
        return regular(path).read_text("utf-8-sig", errors)
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        remedy = "Check the path." if isinstance(problem, FileNotFoundError) else remedy
        raise error(f"cannot read {what} ({reason})", file=path, remedy=remedy) from problem


def parse_toml(
    text: str, file: str | os.PathLike[str] | None, error: type[KinefitError] = FileError
) -> dict[str, Any]:
    """The tables of a TOML text.

    Parameters
    ----------
    file : of the text, for messages.
    error : what is raised.

    Raises
    ------
    `error`
        No TOML, with line and column; or tables so deep, keys or numbers longer than a person writes.
    """
    text = text.removeprefix("\ufeff")  # that some editors of Windows begin a file with
    if len(text) > _MAX_TOML_CHARACTERS:
        raise error(f"a TOML file of {len(text) / 1e6:.0f} MB", file=file, remedy="Is it another file?")
    if (dotted := _DOTTED.search(text)) is not None:  # tomllib's time grows with the square of their number
        place = f"line {text.count(chr(10), 0, dotted.start()) + 1}"
        raise error("not TOML: a key of more than 50 parts", file=file, place=place, remedy="Correct it there.")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(f"not TOML: {problem}", file=file, remedy=_remedy(text, str(problem))) from problem
    except (RecursionError, ValueError) as problem:
        reason = "not TOML: nested too deep, or a number too long"
        raise error(reason, file=file, remedy="Correct it there.") from problem


def record_of(
    data: Any, kind: type[_Record], what: str, file: str | os.PathLike[str], remedy: str,
    error: type[KinefitError] = FileError,
) -> _Record:  # fmt: skip
    """The msgspec record of the tables of a TOML text, or of the bytes of a JSON text.

    Parameters
    ----------
    what, file, remedy : for messages, such as "a body file".
    error : what is raised.

    Raises
    ------
    `error`
        No JSON, or values that such a record does not have, with their place.
    """
    try:
        return msgspec.json.decode(data, type=kind) if isinstance(data, bytes) else msgspec.convert(data, kind)
    except msgspec.ValidationError as problem:
        reason, _, place = str(problem).partition(" - at `$")
        raise error(f"not {what}: {reason}", file=file, place=place.strip(".`") or None, remedy=remedy) from problem
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as problem:
        raise error(f"not valid JSON ({problem})", file=file, remedy=remedy) from problem


def _remedy(text: str, problem: str) -> str:
    """What would work, by the line at fault."""
    at = re.search(r"at line (\d+)", problem)
    line = text.splitlines()[int(at[1]) - 1] if at and int(at[1]) <= len(text.splitlines()) else ""
    value = line.partition("=")[2].partition("#")[0].strip()
    if ("hex value" in problem or "Unescaped" in problem) and "\\" in line:
        path = re.search(r"\"([^\"]*)\"?", line)
        return f'{BACKSLASHES} Write "{with_slashes(path[1])}".' if path and len(path[1]) < 120 else BACKSLASHES
    if re.search("[“”„‟]", line):
        return 'Put straight quotes (") in place of the curly ones of a text program.'
    if value in ("True", "False", "yes", "no", "Yes", "No"):
        return f"Write {'true' if value in ('True', 'yes', 'Yes') else 'false'}."
    if "overwrite" in problem:
        if header := re.match(r"\s*\[\[?([^\[\]]{1,60})\]", line):
            return f"A table that appears several times has two brackets, the first one too: [[{header[1].strip()}]]."
        return "It appears twice: keep one."
    if "twice" in problem and (header := re.match(r"\s*\[\s*([^\[\]]{1,60}?)\s*\]", line)):
        name = header[1]
        return f"If the table may appear several times, write [[{name}]], the first one too. Otherwise keep one."
    if re.fullmatch(r"[^\W\d][^\"'\[\]{}]{0,119}", value):
        return f"Put a text in quotes: {line.partition('=')[0].strip()[:60]} = \"{value}\"."
    return "Put texts in quotes and numbers not, and give numbers a point, not a comma: 1.5."


_ROOM, _RATIO = 256_000_000, 200  # [bytes] that any archive may unpack to; and how often its own size a larger one may
_KINDS = "biufSU"  # of numbers and texts
_Shape = tuple[int, ...]


def read_npz(
    file: str | os.PathLike[str], *names: str, remedy: str, error: type[KinefitError] = FileError
) -> dict[str, NDArray]:
    """The arrays of a numpy archive, each no larger than the bytes that are there.

    Parameters
    ----------
    names : which arrays; those that are not there are left out. Default: all.
    remedy : of the message.
    error : what is raised.

    Raises
    ------
    `error`
        No such file, no archive, damaged, an array of objects, or one that would unpack to very much more than it is.
    """
    path = Path(file)
    if not regular(path).is_file():
        raise error("no such file", file=path, remedy="Check the path.")
    try:
        with zipfile.ZipFile(path) as archive:
            room = max(_ROOM, _RATIO * path.stat().st_size)
            return _members(archive, set(names), room)
    except _Refused as problem:
        raise error(str(problem), file=path, remedy=remedy) from problem
    except Exception as problem:  # zipfile, zlib and numpy have a dozen kinds of errors for what is damaged
        raise error(f"not a numpy archive, or damaged ({_reason(problem)})", file=path, remedy=remedy) from problem


def read_npy(file: str | os.PathLike[str], *, remedy: str) -> NDArray:
    """The array of a numpy file; FileError where it is none, of objects, or longer than the file."""
    path = Path(file)
    try:
        with regular(path).open("rb") as stream:
            return _array(stream, path.stat().st_size, path.name)
    except FileNotFoundError as problem:
        raise FileError("no such file", file=path, remedy="Check the path.") from problem
    except FileError:
        raise
    except Exception as problem:
        reason = str(problem) if isinstance(problem, _Refused) else _reason(problem)
        raise FileError(f"not a numpy array, or damaged ({reason})", file=path, remedy=remedy) from problem


def npy_header(file: str | os.PathLike[str]) -> tuple[_Shape, np.dtype] | None:
    """Shape and type of the array in a numpy file, which is not read; None where it is none."""
    try:
        with regular(file).open("rb") as stream:
            shape, _, dtype = _header(stream)
    except Exception:
        return None
    return shape, dtype


class _Refused(Exception):
    """What a message says of an archive."""


def _reason(problem: Exception) -> str:
    return f"{type(problem).__name__}: {problem}" if str(problem) else type(problem).__name__


def _members(archive: zipfile.ZipFile, names: set[str], room: int) -> dict[str, NDArray]:
    found: dict[str, NDArray] = {}
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if not info.filename.endswith(".npy") or (names and name not in names):
            continue
        room -= info.file_size
        if room < 0:
            raise _Refused(f"array {name!r} of {info.file_size / 1e6:.0f} MB, but the file is much smaller")
        with archive.open(info) as stream:
            found[name] = _array(stream, info.file_size, name)
    return found


def _array(stream: IO[bytes], size: int, name: str) -> NDArray:
    """The array of a stream of `size` bytes, read at once."""
    shape, fortran, dtype = _header(stream)
    count = 1
    for n in shape:
        count *= n
    if dtype.kind not in _KINDS or dtype.fields is not None:
        raise _Refused(f"array {name!r} is of {dtype}, not of numbers or texts")
    if len(shape) > 8 or any(n < 0 for n in shape) or count * max(dtype.itemsize, 1) > size:
        raise _Refused(f"array {name!r} of shape {shape}, but there are {size} bytes")
    data = stream.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise _Refused(f"array {name!r} is cut")
    if isinstance(stream, zipfile.ZipExtFile):
        stream.read()  # to its end, where its sum is checked
    array = np.frombuffer(data, dtype, count) if dtype.itemsize else np.zeros(count, dtype)
    if dtype.kind == "U" and dtype.itemsize:
        codes = array.view(f"{dtype.byteorder}u4")
        if (codes > 0x10FFFF).any() or ((codes >= 0xD800) & (codes < 0xE000)).any():
            raise _Refused(f"array {name!r} has characters that do not exist")
    return array.reshape(shape, order="F" if fortran else "C").copy()


def _header(stream: IO[bytes]) -> tuple[_Shape, bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        return read(stream)
    except MemoryError:  # what Python's parser says of brackets within brackets
        raise ValueError("a header that cannot be understood") from None


_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "Free some space, or write to another disk."),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "Write to a folder that you may change."),
    **dict.fromkeys((errno.EISDIR, errno.ENOTDIR, errno.EEXIST), "A folder or file of that name is in the way."),
}


@contextmanager
def writing(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a temporary path next to `path`; what was written there takes its place when the block ends well.

    Folders on the way are made. After any error, Ctrl-C included, nothing new is left and an older file stays; what a
    process left that was killed, the next one that writes there removes.

    Raises
    ------
    ExportError
        Where the system refuses (full disk, no permission): names the file and the remedy.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise ExportError("a folder or a device of that name is in the way", file=target, remedy="Give another name.")
    temporary = target.with_name(f".{target.stem}-{os.getpid()}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_of_the_dead(target)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "Check the path and the disk.")
        raise ExportError(f"cannot be written ({error.strerror or error})", file=target, remedy=remedy) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def _remove_of_the_dead(target: Path) -> None:
    """Remove temporary files of `target` whose process is there no more."""
    if os.name != "posix":
        return
    for left in target.parent.glob(f".{escape(target.stem)}-*{escape(target.suffix)}"):
        number = left.name.removeprefix(f".{target.stem}-").removesuffix(target.suffix)
        if number.isdecimal():
            try:
                os.kill(int(number), 0)
            except ProcessLookupError:
                left.unlink(missing_ok=True)
            except (OSError, OverflowError):  # another user's, which lives
                pass


def write_text(path: str | PathLike[str], text: str) -> None:
    """Write a whole text file (UTF-8, line ends as they are) or nothing."""
    with writing(path) as temporary:
        temporary.write_bytes(printable(text).encode("utf-8"))


def write_lines(path: str | PathLike[str], lines: Iterable[str]) -> None:
    """Write a whole text file (UTF-8), line by line as they are made, or nothing."""
    with writing(path) as temporary, temporary.open("w", encoding="utf-8", errors="replace", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)


def write_bytes(path: str | PathLike[str], data: bytes) -> None:
    """Write a whole binary file or nothing."""
    with writing(path) as temporary:
        temporary.write_bytes(data)


def write_rows(path: str | PathLike[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a whole CSV file, row by row, or nothing."""
    with writing(path) as temporary, temporary.open("w", encoding="utf-8", errors="replace", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def write_image(path: str | PathLike[str], image: NDArray) -> None:
    """Write an image (H, W, 3) uint8 BGR as JPEG, or as PNG by any other ending, whole or not at all."""
    import cv2

    kind = ".jpg" if Path(path).suffix.lower() in (".jpg", ".jpeg") else ".png"
    write_bytes(path, cv2.imencode(kind, image)[1].tobytes())


LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "in": 0.0254, "ft": 0.3048}
"""{unit: metres}; `worth` reads the words, too."""

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""{unit: seconds}."""


def worth(unit: Any, units: dict[str, float]) -> float | None:
    """Value of a unit in metres or seconds, ignoring case, also of "inches", "millimetres"; None of any other."""
    if not isinstance(unit, str):
        return None
    return units.get(re.sub(r"^([cm]?)(?:enti|illi)?met(?:er|re)s?$", r"\1m", unit.strip().lower()).removesuffix("es"))


_STATURES_M = (0.3, 3.0)


def stature_of(text: str | float) -> float:
    """A stature [m] as people write it: "1.75", "1,75", "175", "175 cm", "1.75 m"; a number above 3 is centimetres.

    Raises
    ------
    ObservationError
        No number, another unit than of length, or a person of less than 0.3 or more than 3 m.
    """
    found = re.fullmatch(r"(\d+(?:[.,]\d+)?)\s*([a-z]*)", str(text).strip().lower())
    number = float(found[1].replace(",", ".")) if found else np.nan
    unit = worth(found[2] or ("m" if number < _STATURES_M[1] else "cm"), LENGTHS) if found else None
    if unit is None or not _STATURES_M[0] < number * unit < _STATURES_M[1]:
        raise ObservationError(f"{str(text)!r} is no stature", remedy="Give metres or centimetres: 1.75 or 175.")
    return round(number * unit, 4)


def metres_of(unit: str, error: type[KinefitError], what: str = "unit", **more: Any) -> float:
    """Metres of a unit of length; `error`, with the units that there are, for any other."""
    if (metres := worth(unit, LENGTHS)) is None:
        raise error(choices(what, unit, LENGTHS), **more)
    return metres
