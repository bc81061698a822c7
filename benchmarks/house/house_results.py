"""What the commands make of shared recordings, before and after a redesign: joints, angles, bars, findings, seconds.

`python -m benchmarks.house.house_results write FILE` runs the commands with their defaults and writes the
results of some frames; `python -m benchmarks.house.house_results compare FILE` runs them again and prints what differs.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed.mixed_runs import MIXES
from benchmarks.accuracy.mixed.mixed_takes import record, take_text, write
from benchmarks.commands import ended
from benchmarks.figures import data
from kinefit import read_motion

_MAX_FRAMES = 30  # of a motion that are kept, spread over it
FOLDERS = ("video_balancing_4cam", "video_two_people_4cam", "video_mono_opencap/STS", "mv4_landmarks_caliscope")
MARKER_FILES = (
    "markers_bmc_run/Gait.c3d", "markers_pycgm/Test_Files/Movement_trial.c3d", "markers_bmc_run/walk1.trc",
)  # fmt: skip
DRAWN = {"drawn cameras": "cameras", "drawn mix": "cameras_depth", "drawn masks": "cameras_silhouettes"}
_DRAW = 1234

Results = dict[str, NDArray]


def results() -> dict[str, Results]:
    """{name of the recording: its results} of all recordings that are there; one that fails has its message alone."""
    out = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, make in _takes(Path(folder)):
            out[name] = _run(make(), Path(folder) / f"{len(out)}.out")
            print(f"# {name}: {float(out[name].get('seconds', np.nan)):.0f} s", flush=True)
    return out


def _takes(room: Path) -> Iterator[tuple[str, Callable[[], list[str]]]]:
    """Name of each recording, and what gives the command that reads it."""
    for name in FOLDERS:
        if (source := data(name)) is not None:
            yield name, partial(_initialised, source, room / name.replace("/", "_"))
    for name in MARKER_FILES:
        if (source := data(name)) is not None:
            yield name, partial(_words, "markers", "fit", str(source))
    for name, mix in DRAWN.items():
        yield name, partial(_drawn, room / "drawn", mix)


def _words(*words: str) -> list[str]:
    return [*words, "--formats", "motion"]


def _drawn(folder: Path, mix: str) -> list[str]:
    """The command for one mix of sensors of a drawn recording, which the first call writes."""
    if not folder.exists():
        write(record(_DRAW, 60), folder)
    (folder / f"{mix}.toml").write_text(take_text(folder, MIXES[mix]))
    return _words("track", str(folder / f"{mix}.toml"))


def _initialised(source: Path, copy: Path) -> list[str]:
    """The command for a folder of links to a recording, whose take `kinefit init` writes."""
    for path in sorted(source.rglob("*")):
        if path.is_file():
            (copy / path.relative_to(source)).parent.mkdir(parents=True, exist_ok=True)
            (copy / path.relative_to(source)).symlink_to(path)
    ended("init", copy)
    return _words("track", str(copy / "take.toml"))


def _run(words: list[str], out: Path) -> Results:
    """Results of one command, every array of at most so many frames."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = ended(*words, "--out", out)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = sorted(out.rglob("motion.npz"))
    if done.returncode or not found:
        return {"message": np.array((done.stderr or done.stdout)[-500:])}
    motion = read_motion(found[0])
    some = np.unique(np.linspace(0, len(motion) - 1, _MAX_FRAMES).astype(int))
    findings = sorted(f"{one['severity']} {one['kind']}" for one in motion.provenance.get("findings", ()))
    return {
        "joints": motion.joint_centres[some].astype(np.float32), "angles": motion.angles[some].astype(np.float32),
        "joint_std": motion.joint_std[some].astype(np.float32), "quality": motion.quality[some].astype(np.float32),
        "findings": np.array(findings, np.str_),
        "seconds": np.array(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime),
    }  # fmt: skip


def compared(a: Results, b: Results) -> str:
    """How two results differ, in one line."""
    if "message" in a or "message" in b:
        same = str(a.get("message", "")) == str(b.get("message", ""))
        return "the same error" if same else f"{a.get('message', 'a motion')} -> {b.get('message', 'a motion')}"
    if a["joints"].shape != b["joints"].shape:
        return f"joints of shape {a['joints'].shape} -> {b['joints'].shape}"
    off = 1000 * np.linalg.norm(a["joints"] - b["joints"], axis=-1)
    with np.errstate(all="ignore"):
        bars = np.nanmedian(b["joint_std"] / a["joint_std"])
        angles = np.degrees(np.nanmedian(np.abs(a["angles"] - b["angles"])))
    lost = sorted({*a["findings"].tolist()} ^ {*b["findings"].tolist()})
    return (
        f"joints {np.nanmedian(off):.2f} mm (most {np.nanmax(off):.1f}), angles {angles:.2f} deg, bars x {bars:.3f}, "
        f"seconds {float(a['seconds']):.0f} -> {float(b['seconds']):.0f}{', findings ' * bool(lost)}{', '.join(lost)}"
    )


def main(words: list[str]) -> None:
    """Write or compare."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    how, file = words
    found = results()
    if how == "write":
        flat = {f"{name}|{key}": array for name, one in found.items() for key, array in one.items()}
        np.savez_compressed(file, **flat)
        return
    with np.load(file) as before:
        for name, one in found.items():
            old = {key.partition("|")[2]: before[key] for key in before.files if key.startswith(f"{name}|")}
            print(f"{name}: {compared(old, one) if old else 'not in the record'}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
