"""Work on the videos of several cameras at once, which ends well; and what tells a video from another."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from kinefit._threads import cores
from kinefit.errors import FileError

Step = Callable[[str, int, int], None]
"""Called with what is done, how much of it is done, and how much there is (0: unknown)."""

Tell = Callable[[str], None]
"""Called with what is worth saying."""

_ENDS = 2**20  # [bytes] of a video's begin and end by which it is recognised
J = TypeVar("J")


def each_video(jobs: Sequence[J], work: Callable[[J, Step], None], progress: Step | None, *, of: int) -> None:
    """Do the work on each video, as many at a time as there are cores.

    Parameters
    ----------
    work : called with a job and what tells its progress, which raises where another job failed or Ctrl-C came
    of : how many videos there are, with those that are done already

    Raises
    ------
    KeyboardInterrupt
        With how many are done, which are kept.
    """
    stop, lock = threading.Event(), threading.Lock()

    def step(camera: str, done: int, total: int) -> None:
        if stop.is_set():
            raise _Stopped
        if progress:
            with lock:
                progress(camera, done, total)

    with _one_thread_each(), ThreadPoolExecutor(min(len(jobs), cores())) as pool:
        futures = [pool.submit(work, job, step) for job in jobs]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        except KeyboardInterrupt as stopped:
            kept = of - len(jobs) + sum(future.done() for future in futures)
            message = f"{kept} of {of} videos are done. Run the same command to continue with the others."
            raise KeyboardInterrupt(message) from stopped
        finally:  # after an error, or Ctrl-C: those that run end at their next picture
            stop.set()
            for future in futures:
                future.cancel()
    for future in done:
        future.result()


class _Stopped(Exception):
    """Another camera failed, or Ctrl-C came."""


def video_key(path: Path, rate: float | None, method: str) -> str:
    """Text that another video, or another method, does not have; `rate` [Hz] is that of images in a folder.

    Raises
    ------
    FileError
        The video cannot be read.
    """
    from kinefit.readers.videos.video import images_in

    digest, size = hashlib.sha256(), 0
    images = images_in(path) if path.is_dir() or "*" in path.name else []
    try:
        for part in images or [path]:
            with part.open("rb") as file:
                length = file.seek(0, os.SEEK_END)
                for start in (0, max(0, length - _ENDS // max(1, len(images)))):
                    file.seek(start)
                    digest.update(file.read(_ENDS // max(1, len(images))))
            size += length
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror})", file=path, remedy="Check the path.") from error
    if images:
        digest.update(f"{len(images)} {rate}".encode())
    return f"{digest.hexdigest()[:32]} {size} {method}"


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """OpenCV without threads of its own: the cameras run side by side."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
