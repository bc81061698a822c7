"""Wrong and unusual inputs through the door, with a user's commands: right, said, or unsaid.

Right: the command gives the result that the user meant. Said: an error, a finding or a note names the cause. Unsaid:
neither, or a warning of Python's own, or an exception that is not kinefit's.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import kinefit
from benchmarks.faults_users_files import MM, scene, videos, write_depth
from benchmarks.faults_users_pictures import QUIET, write_video
from benchmarks.faults_users_pictures import run as command
from benchmarks.figures import amount, data, figure
from kinefit.exporters import write_markers
from kinefit.observations import Markers

Answer = Callable[[Path], str]
GAIT = "gait_omcs/overground.c3d"
KINECT = "depth_skeltrack_kinect1"
_OF_PYTHON = re.compile(r"(Runtime|User|Deprecation)Warning|Traceback|Error in kinefit", re.IGNORECASE)


def run() -> None:
    """Print how many inputs end right, said and unsaid, and each with its state."""
    present = {name: answer for name, answer in DOORS.items() if data(name.partition(": ")[0]) or ": " in name}
    chosen = dict(list(present.items())[: amount(None, 8)])
    counts = Counter(_state(name, answer) for name, answer in chosen.items())
    whole = chosen == DOORS and data(KINECT) is not None
    for state, goal in (("right", ">= 12"), ("said", ">= 12"), ("unsaid", "<= 0")):
        figure(f"product_doors_{state}", counts[state], f"of {len(DOORS)}", goal, whole=whole)
    figure("product_doors_right_or_said", counts["right"] + counts["said"], f"of {len(DOORS)}", ">= 30", whole=whole)


def _state(name: str, answer: Answer) -> str:
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where) / "session"  # calibrations beside it would be taken, too
        folder.mkdir()
        try:
            state = answer(folder)
        except Exception:
            traceback.print_exc(limit=3)
            state = "unsaid"
    print(f"# {state}: {name}", flush=True)
    return state
