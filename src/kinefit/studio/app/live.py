"""Live sessions of `kinefit live` in processes of their own, each with its page at an address that is known."""

from __future__ import annotations

import secrets
import socket
import time
from pathlib import Path

from kinefit.errors import KinefitError
from kinefit.readers.take.cameras import is_uncalibrated
from kinefit.readers.take.checks import streams_of
from kinefit.readers.take.file import read_take
from kinefit.studio.app.folders import takes_below
from kinefit.studio.app.jobs import Job, JobQueue
from kinefit.studio.serving import TOKEN_VARIABLE
from kinefit.studio.serving.access import Access
from kinefit.takes.missing import cameras_file, last_found

_HOST, _CONNECT_TIMEOUT_S = "127.0.0.1", 0.2


def followable(root: Path) -> dict[Path, bool]:
    """{take file: whether its sensors have streams} of the takes below a folder whose cameras' places are known.

    Those without streams are replayed.
    """
    found = {}
    for take in takes_below(root):
        try:
            read = read_take(take.file)
            if not is_uncalibrated(last_found(read)):
                found[take.file] = bool(streams_of(read))
        except KinefitError:
            continue
    return dict(sorted(found.items(), key=lambda item: not item[1]))


def found_cameras(root: Path) -> list[Path]:
    """Files of cameras that were found from the people in the takes below a folder."""
    return [file for take in takes_below(root) if (file := cameras_file(take.file)).is_file()]


def start_live(jobs: JobQueue, take: Path) -> Job:
    """Follow a take live in a folder of its own, beside the queue."""
    out = take.with_name(f"{take.stem}-live-{time.strftime('%Y%m%d-%H%M%S')}")
    with socket.create_server((_HOST, 0)) as server:
        port = server.getsockname()[1]
    command = ("live", str(take), "--out", str(out), "--port", str(port))
    return jobs.start_beside(take, command, {TOKEN_VARIABLE: secrets.token_urlsafe(18)})


def page_of(job: Job) -> str:
    """Address of the page of a live session, with its token."""
    return Access(token=job.environment[TOKEN_VARIABLE]).url(int(_option(job, "--port")))


def is_up(job: Job) -> bool:
    """Whether the page of a live session answers."""
    try:
        socket.create_connection((_HOST, int(_option(job, "--port"))), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError:
        return False
    return True


def recorded_take(job: Job) -> Path | None:
    """The take file that a live session left; None if there is none."""
    file = Path(_option(job, "--out")) / "take.toml"
    return file if file.is_file() else None


def _option(job: Job, name: str) -> str:
    return job.command[job.command.index(name) + 1]
