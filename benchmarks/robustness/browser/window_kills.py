"""SIGKILL of `kinefit app` at ten moments while it computes a session of 20 takes: all go on, to the same results.

The takes are simulated: a fit of a real one takes minutes.
"""

from __future__ import annotations

import random
import re
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import NotMeasured, amount, figure, quick
from benchmarks.robustness.browser.window import CHROMIUM, WAIT_MS, chromium, open_page, running_app
from kinefit.readers.motion import read_motion
from kinefit.simulation.recordings import write_synthetic_take


def run() -> None:
    """Print whether all sessions survive."""
    if CHROMIUM is None:
        raise NotMeasured("no Chromium")
    with chromium() as browser:
        _kill(browser)


def _kill(browser: Any) -> None:
    """Kill the app at ten moments, go on each time, and compare all results."""
    takes, kills = amount((20, 10), (2, 1))
    survived, moments = 0, random.Random(36)
    with tempfile.TemporaryDirectory() as work:
        for k in range(takes):
            write_synthetic_take(Path(work) / f"take{k:02}")
        for _ in range(kills):
            with running_app(Path(work)) as (process, address):
                page = open_page(browser, address)
                _ask_for_rest(page, address)
                page.wait_for_timeout(1000.0 * moments.uniform(2.0, 25.0))
                process.kill()
            page.context.close()
            time.sleep(5.0)  # in which its command writes what is done
            survived += _is_whole(Path(work))
        with running_app(Path(work)) as (_, address):
            page = open_page(browser, address)
            _ask_for_rest(page, address)
            page.wait_for_function(
                "n => document.body.innerText.split('done').length > n", arg=takes, timeout=WAIT_MS, polling=500
            )
        motions = [read_motion(file) for file in sorted(Path(work).glob("*/take-kinefit/motion.npz"))]
        same = all(np.array_equal(motion.angles, motions[0].angles) for motion in motions)
        print(f"# {len(motions)} of {takes} takes are done, equal to the last digit: {same}")
        figure("window_kills", survived if same and len(motions) == takes else 0, "sessions of 10", "== 10",
               whole=not quick())  # fmt: skip


def _ask_for_rest(page: Any, address: str) -> None:
    """Ask for all takes of the table that are not done."""
    page.goto(f"{address}session")
    rows = page.locator("tbody tr").filter(has_text=re.compile("not computed yet|stopped before its end"))
    page.locator("tbody tr").first.wait_for()
    for k in range(rows.count()):
        rows.nth(k).locator(".q-checkbox").click()
    page.get_by_role("button", name="Compute all").click()


def _is_whole(folder: Path) -> bool:
    """Whether every motion that lies in a session can be read, and no file was left half written."""
    for file in folder.glob("*/take-kinefit/motion.npz"):
        read_motion(file)
    return not list(folder.rglob(".motion-*"))
