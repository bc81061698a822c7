"""Records of laboratory walks by `kinefit gait`, each file alone, and two walks of a person together.

    python -m benchmarks gait gait_record

The files are those of `gait_events`, in each of which a foot meets the ground twice, and walks of another laboratory
(an adult, 1.3 s at 100 Hz, with a static trial), in which each foot meets the ground once: half a cycle, a single step.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.accuracy.gait.gait_events import CHOSEN, PRINTED, file_of, fitted
from benchmarks.commands import ended
from benchmarks.figures import amount, data, figure
from kinefit.exporters import write_motion

_WALKS = ("walking1", "walking2", "walkingTO1", "walkingTS1")


def run() -> None:
    """Print of how many files the command gives a record, and whether two walks come together."""
    files = [path for name in (*PRINTED, *CHOSEN) if (path := file_of(name)) is not None]
    folder = data("forces_nimblephysics")
    files += [] if folder is None else [folder / "subject4" / f"{name}.trc" for name in _WALKS]
    found = dict[str, tuple[int, int]]()
    with tempfile.TemporaryDirectory() as out:
        for path in files[: amount(None, 1)]:
            name = f"{path.parent.name}-{path.stem}"
            write_motion(fitted(path), Path(out) / name / "motion.npz")
            found[name] = _counts([Path(out) / name])
            print(f"# {name}: {found[name][0]} strides, {found[name][1]} single steps")
        pair = [Path(out) / name for name in ("HC030A-straight", "HC030A-turn")]
        both = _counts(pair) if all(path.is_dir() for path in pair) else None
    reason = "" if found else "no recording"
    share = 100.0 * sum(map(any, found.values())) / len(found) if found else None
    figure("gait_command_records", share, "% of files", ">= 100", reason)
    lacking = None if both is None else sum(sum(found[path.name]) for path in pair) - sum(both)
    missing = "" if lacking is not None else "one file alone"
    figure("gait_command_lost", lacking, "strides and steps of two walks together", "== 0", missing)


def _counts(motions: list[Path]) -> tuple[int, int]:
    """Numbers of strides and of single steps in the record of motions; none without a record."""
    done = ended("gait", *motions, "--out", motions[0].parent / "gait", "--json")
    if done.returncode:
        print(f"# {done.stderr.strip()}")
        return 0, 0
    found: dict[str, Any] = json.loads(done.stdout)
    walks = [found[walk] for walk in ("straight", "turning")]
    return sum(sum(of["strides"].values()) for of in walks), sum(sum(of["steps"].values()) for of in walks)
