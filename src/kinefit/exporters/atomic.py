"""Writing that leaves either the whole file or what was there before."""

from __future__ import annotations

import csv
import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from os import PathLike
from pathlib import Path

from numpy.typing import NDArray

from kinefit.errors import ExportError, printable

_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "Free some space, or write to another disk."),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "Write to a folder that you may change."),
    **dict.fromkeys((errno.EISDIR, errno.ENOTDIR, errno.EEXIST), "A folder or file of that name is in the way."),
}


@contextmanager
def writing(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; what was written there takes its place when the block ends well.

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
