"""Run commands of kinefit in processes of their own, one at a time, and follow their events."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kinefit._processes import environment, python

WAITING, RUNNING, DONE, PAUSED, FAILED = "waiting", "running", "done", "paused", "failed"
"""States of a job."""

_INTERRUPTED = 130  # exit code of a command that was stopped as by Ctrl-C
_MAX_LINE_BYTES = 2**22  # of an event, or of a line of a result
_PAUSE_TIMEOUT_S = 60.0  # in which a command that is asked to stop has written what is done


@dataclass
class Progress:
    """How far one piece of work of a command is."""

    done: int
    total: int
    begun: float
    changed: float

    @property
    def share(self) -> float:
        """Share that is done, 0 to 1."""
        return self.done / self.total if self.total else 0.0

    @property
    def seconds_left(self) -> float | None:
        """[s] that the rest takes at the mean speed so far; None before the first part is done."""
        if not self.total or not self.done:
            return None
        return (self.changed - self.begun) * (self.total - self.done) / self.done


@dataclass(eq=False)
class Job:
    """One command for one take.

    Parameters
    ----------
    take : Path of the take file
    command : words after `kinefit`

    Attributes
    ----------
    state : of WAITING, RUNNING, DONE, PAUSED and FAILED
    steps : {name of the work: Progress}, in the order of their begin
    notes : sentences of the command
    error : {"problem", "at", "try"} of a command that failed
    result : what the command prints with --json; None before its end
    printed : what the command printed on its standard output; "" before its end
    environment : further variables of the process, such as a token, which a command line would show to others
    """

    take: Path
    command: tuple[str, ...]
    state: str = WAITING
    steps: dict[str, Progress] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    error: dict[str, str] | None = None
    result: dict[str, Any] | None = None
    printed: str = ""
    environment: dict[str, str] = field(default_factory=dict)
    _process: asyncio.subprocess.Process | None = None

    @property
    def kind(self) -> str:
        """First word of the command: "check", "track" and so on."""
        return self.command[0]

    @property
    def is_open(self) -> bool:
        """Whether it waits or runs."""
        return self.state in (WAITING, RUNNING)

    async def run(self) -> None:
        """Run the command to its end, or until it is paused."""
        if self.state != WAITING:
            return
        self.state = RUNNING
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *python("-m", "kinefit", "--events", *self.command), stdin=pipe, stdout=pipe, stderr=pipe,
            limit=_MAX_LINE_BYTES, env=environment(**self.environment, PYTHONIOENCODING="utf-8"),
        )  # fmt: skip
        self._process = process
        assert process.stdout is not None
        printed, _ = await asyncio.gather(process.stdout.read(), self._follow(process))
        code = await process.wait()
        with suppress(ValueError):
            self.printed = printed.decode("utf-8", "replace")
            self.result = json.loads(printed)
        self.state = DONE if code == 0 else PAUSED if code == _INTERRUPTED else FAILED
        if self.state == FAILED and self.error is None:
            last = "\n".join(self.notes[-3:]) or f"exit code {code}"
            self.error = {"problem": last, "at": " ".join(("kinefit", *self.command)), "try": ""}

    async def _follow(self, process: asyncio.subprocess.Process) -> None:
        assert process.stderr is not None
        while line := await process.stderr.readline():
            try:
                self.take_event(json.loads(line))
            except ValueError:  # of a library that prints
                self.notes.append(line.decode("utf-8", "replace").rstrip())

    def take_event(self, event: dict[str, Any]) -> None:
        """Take in an event of the command; raises ValueError if it is none."""
        kind = event.pop("event", None) if isinstance(event, dict) else None
        now = time.monotonic()
        if kind == "step":
            known = self.steps.setdefault(event["what"], Progress(0, 0, now, now))
            known.done, known.total, known.changed = event["done"], event["total"], now
        elif kind == "note":
            self.notes.append(event["text"])
        elif kind == "error":
            self.error = event
        else:
            raise ValueError(f"no event of kinefit: {event!r}")

    def pause(self) -> None:
        """Let the command write what is done and end; a job that waits leaves the queue."""
        if self.state == WAITING:
            self.state = PAUSED
        elif self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()


class JobQueue:
    """Jobs in the order in which they were asked for; one runs at a time, since each uses all cores.

    Attributes
    ----------
    jobs : of the queue
    sessions : live, which run at the same time as the queue until they are ended
    """

    def __init__(self) -> None:
        self.jobs: list[Job] = []
        self.sessions: list[Job] = []
        self._task: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    def add(self, take: Path, command: Sequence[str]) -> Job:
        """Append a command for a take; the take's open job of the same kind, if there is one, stands for it."""
        for job in self.jobs:
            if job.take == take and job.is_open and job.kind == command[0]:
                return job
        job = Job(take, tuple(command))
        self.jobs = [old for old in self.jobs if old.take != take or old.kind != job.kind]
        self.jobs.append(job)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._work())
        return job

    def start_session(self, take: Path, command: Sequence[str], environment: Mapping[str, str]) -> Job:
        """Run a command immediately, outside of the queue."""
        job = Job(take, tuple(command), environment=dict(environment))
        self.sessions = [*(old for old in self.sessions if old.is_open), job]
        task = asyncio.create_task(_run(job))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return job

    def of(self, take: Path, kind: str) -> Job | None:
        """The last job of a kind for a take."""
        return next((job for job in reversed(self.jobs) if job.take == take and job.kind == kind), None)

    def open(self, take: Path) -> Job | None:
        """The job of a take that waits or runs."""
        return next((job for job in self.jobs if job.take == take and job.is_open), None)

    async def _work(self) -> None:
        while job := next((job for job in self.jobs if job.state == WAITING), None):
            await _run(job)

    async def close(self) -> None:
        """Pause all jobs and wait until what is done is written."""
        for job in (*self.jobs, *self.sessions):
            if job.is_open:
                job.pause()
        if tasks := [*self._tasks, *([self._task] if self._task else [])]:
            await asyncio.wait(tasks, timeout=_PAUSE_TIMEOUT_S)


async def _run(job: Job) -> None:
    try:
        await job.run()
    except OSError as error:  # no memory for a process
        job.state, job.error = FAILED, {"problem": str(error), "at": " ".join(job.command), "try": ""}
