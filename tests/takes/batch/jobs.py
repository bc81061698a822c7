"""Jobs for workers, which import them: some end well, some do not."""

import os
import signal
import time
from pathlib import Path

from kinefit.takes.batch.processes import _Beat, progress


def square(number):
    return number * number


def slow_first(number):
    time.sleep(0.6 if number == 0 else 0.0)
    return number


def odd_is_wrong(number):
    if number % 2:
        raise RuntimeError(f"{number} is odd")
    return number


def dies_once(marker):
    if Path(marker).exists():
        return "alive"
    Path(marker).touch()
    os.kill(os.getpid(), signal.SIGKILL)


def killed(number):
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def killed_later(number):
    """Beside 0, which takes longer, 1 kills them both."""
    time.sleep(0.2 if number == 1 else 1.0)
    return killed(number)


def threads(_):
    return os.environ["OMP_NUM_THREADS"], os.getpid()


def reports(number):
    for _ in range(3):
        _Beat.last = 0.0
        progress("step", 1, 3)
    return number


def hangs(number):
    if number == 1:
        progress("step", 1, 3)
        time.sleep(600)
    return number
