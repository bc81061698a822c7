"""Start processes that import and run nothing of the current folder, which may hold the files of strangers."""

from __future__ import annotations

import os
import shutil
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

_START_LOCK = threading.RLock()  # environment and search path belong to all threads


def python(*words: str) -> list[str]:
    """Command that runs Python with these words; run it with `environment()`."""
    return [sys.executable, "-P", *words]


def environment(**more: str) -> dict[str, str]:
    """Environment of a new process: this one's and `more`, with the current folder on no search path."""
    searched = {name: os.environ[name].split(os.pathsep) for name in ("PATH", "PYTHONPATH") if name in os.environ}
    paths = {name: os.pathsep.join(_elsewhere(folders)) for name, folders in searched.items()}
    return {**os.environ, **paths, "PYTHONSAFEPATH": "1", "NoDefaultCurrentDirectoryInExePath": "1", **more}


def program(name: str) -> str | None:
    """Path of an installed program; None where there is none, or one by way of the current folder."""
    found = shutil.which(name, path=environment().get("PATH"))
    return found if found and os.path.isabs(found) and Path(found).parent != Path.cwd() else None


def _elsewhere(folders: Iterable[str]) -> list[str]:
    """Folders of a search path without "", "." and "..", which depend on the current folder."""
    return [folder for folder in folders if folder.strip("./")]


@contextmanager
def starting(**more: str) -> Iterator[None]:
    """Context in which `multiprocessing` starts processes with `environment(**more)` and a `sys.path` like it."""
    with _START_LOCK:
        changed = {name: text for name, text in environment(**more).items() if os.environ.get(name) != text}
        before, path = {name: os.environ.get(name) for name in changed}, sys.path
        os.environ.update(changed)
        sys.path = _elsewhere(sys.path)
        try:
            yield
        finally:
            sys.path = path
            for name, text in before.items():
                os.environ.pop(name) if text is None else os.environ.update({name: text})
