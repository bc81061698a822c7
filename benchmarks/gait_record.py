"""Records of laboratory walks by `kinefit gait`, each file alone, and two walks of a person together.

    python -m benchmarks.gait gait_record

The files are those of `gait_events`, and walks of another laboratory (an adult, 100 Hz, with a static trial). In each
a foot meets the ground twice.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.figures import amount, data, figure
from benchmarks.gait_events import CHOSEN, PRINTED, file_of, fitted
from kinefit.exporters import write_motion

_WALKS = ("walking1", "walking2", "walkingTO1", "walkingTS1")


def run() -> None:
    """Print of how many files the command gives a record with strides, and whether two walks come together."""
    files = [path for name in (*PRINTED, *CHOSEN) if (path := file_of(name)) is not None]
    folder = data("forces_nimblephysics")
    files += [] if folder is None else [folder / "subject4" / f"{name}.trc" for name in _WALKS]
    strides = dict[str, int]()
    with tempfile.TemporaryDirectory() as out:
        for path in files[: amount(None, 1)]:
            name = f"{path.parent.name}-{path.stem}"
            write_motion(fitted(path), Path(out) / name / "motion.npz")
            strides[name] = _strides([Path(out) / name])
            print(f"# {name}: {strides[name]} strides")
        pair = [Path(out) / name for name in ("HC030A-straight", "HC030A-turn")]
        both = _strides(pair) if all(path.is_dir() for path in pair) else None
    reason = "" if strides else "no recording"
    share = 100.0 * sum(map(bool, strides.values())) / len(strides) if strides else None
    figure("gait_command_records", share, "% of files", ">= 100", reason)
    lacking = None if both is None else sum(strides[path.name] for path in pair) - both
    missing = "" if lacking is not None else "one file alone"
    figure("gait_command_lost", lacking, "strides of two walks together", "== 0", missing)


def _strides(motions: list[Path]) -> int:
    """Number of strides in the record of motions; 0 without a record."""
    command = [sys.executable, "-m", "kinefit", "gait", *map(str, motions), "--out", str(motions[0].parent / "gait")]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True)
    if done.returncode:
        print(f"# {done.stderr.strip()}")
        return 0
    found: dict[str, Any] = json.loads(done.stdout)
    return sum(sum(found[walk]["strides"].values()) for walk in ("straight", "turning"))
