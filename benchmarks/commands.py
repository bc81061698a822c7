"""Commands of kinefit as a user gives them: in this process, or in one of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

from click.testing import CliRunner, Result

from kinefit.cli import main

QUIET = ("--no-overlays", "--no-report", "--formats", "motion", "--realtime", "--restart")
"""Options of `kinefit track` of which a motion alone is read."""


def invoked(*words: object) -> Result:
    """A command in this process, when it has ended."""
    return CliRunner().invoke(main, [str(word) for word in words])


def answer(*words: object) -> tuple[int, str]:
    """Exit code of a command in this process, and all that it prints, on one line."""
    result = invoked(*words)
    return result.exit_code, " ".join(result.output.split())


def printed(*words: object) -> str:
    """What a command in this process prints.

    Raises
    ------
    RuntimeError
        Where it ends with an error.
    """
    result = invoked(*words)
    if result.exit_code:
        raise RuntimeError(f"{words[0]}: {result.output}")
    return result.output


def command(*words: object) -> list[str]:
    """The words of a process of its own."""
    return [sys.executable, "-m", "kinefit", *map(str, words)]


def ended(*words: object, check: bool = False, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, when it has ended; options of `subprocess.run`.

    Raises
    ------
    RuntimeError
        With `check`, where it ends with an error.
    """
    done = subprocess.run(command(*words), capture_output=True, text=True, **options)
    if check and done.returncode:
        raise RuntimeError(f"{words[0]}: {done.stderr}")
    return done


def begun(*words: object, env: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
    """A command in a process of its own, which prints nothing."""
    return subprocess.Popen(command(*words), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=env)


def used(*words: object, env: dict[str, str] | None = None) -> tuple[float, float]:
    """What a command in a process of its own took: [s] of the processor, and [MB] of memory at most.

    Raises
    ------
    RuntimeError
        Where it ends with an error.
    """
    process = begun(*words, env=env)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"kinefit {' '.join(map(str, words))} ended with code {process.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
