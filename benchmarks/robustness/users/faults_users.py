"""Inputs that users reported: how many are answered rightly, how many siblings of each, and false alarms on right ones.

An answer is right where the value is, or where the error or the note names what is wrong. Each case goes through the
command or the public function that a user calls, with its defaults.
"""

from __future__ import annotations

import tempfile
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks.figures import amount, figure, module_of, recording

MODULES = ("markers", "calibration", "skeletons", "pictures", "sides")
"""Modules `faults_users_*` with CASES and SIBLINGS: {name: whether the answer to what lies in a folder is right}."""

KINDS = ("bvh", "c3d", "calibration", "keypoints", "markers", "openpose", "trc", "video-avi", "video-mirrored")
"""Begins of the names of the cases that these modules answer."""

Answer = Callable[[Path], bool]


def run() -> None:
    """Print the shares, and the names of what is wrong."""
    modules = [module_of(f"faults_users_{name}") for name in MODULES]
    siblings = {name: answer for module in modules for name, answer in module.SIBLINGS.items()}
    siblings = dict(list(siblings.items())[: amount(None, 4)])
    with tempfile.TemporaryDirectory() as folder:
        for number in range(len(siblings)):
            (Path(folder) / str(number)).mkdir()
        folders = {name: Path(folder) / str(number) for number, name in enumerate(siblings)}
        right = _right(siblings, folders)
    figure("faults_users_siblings", 100 * right / len(siblings), f"% of {len(siblings)}", "== 100")
    root = recording("cases_of_users")
    cases = {name: answer for module in modules for name, answer in module.CASES.items()}
    folders = {path.name: path for path in sorted(root.iterdir()) if path.is_dir() and path.name.startswith(KINDS)}
    missing = sorted(folders.keys() - cases.keys())
    print(f"# no answer is looked at: {', '.join(missing)}" if missing else f"# {len(folders)} cases", flush=True)
    right = _right({name: cases[name] for name in list(folders)[: amount(None, 4)] if name in cases}, folders)
    figure("faults_users_cases", 100 * right / amount(len(folders), 4), f"% of {amount(len(folders), 4)}", "== 100")
    for module in modules:
        if hasattr(module, "run"):
            module.run()


def _right(answers: Mapping[str, Answer], folders: Mapping[str, Path]) -> int:
    """How many are right; a case that ends in an exception is wrong, and is shown."""
    count = 0
    for name, answer in answers.items():
        try:
            is_right = answer(folders[name])
        except Exception:
            traceback.print_exc(limit=3)
            is_right = False
        if not is_right:
            print(f"# wrong: {name}", flush=True)
        count += is_right
    return count
