"""Unfinished folders: crafted ones, SIGKILL at any moment, memory: `python -m benchmarks faults faults_folder`.

A crafted folder holds a pickle that writes a file where it is read. Kills come at random moments of `kinefit track` on
a simulated take: half of them by the clock, half by how much is written, which is while frames are tracked.
"""

from __future__ import annotations

import ast
import pickle
import random
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

import kinefit
from benchmarks.figures import LEFT_OUT, amount, figure, quick
from benchmarks.speed.long import command, same_results, tracked, write_long_take
from kinefit.errors import KinefitError
from kinefit.fitting.tracking.checkpoints.checkpoint import FORMAT, FRAME, STATE, Checkpoint, key_of
from kinefit.readers.take.file import Take, read_take
from kinefit.takes.track import track_take

LONG, KILLS = 20_000, 20
_FRAMES, _BYTES = amount(700, 160), 10_000  # frames of the take that is killed; of a frame, about
_OPTIONS = "--no-report", "--no-overlays", "--formats", "motion,csv"
_UNPICKLING = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
MACHINE_CODE = {"_jit.py"}
"""numba pickles compiled kernels: machine code, which runs in any format. So the folder is the user's alone."""


class _Evil:
    """Writes a file where it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.file,)


def unpickling_modules() -> list[str]:
    """Modules of kinefit that could unpickle: they import what does, or let numpy do it; but for `MACHINE_CODE`."""
    package, found = Path(kinefit.__file__).parent, []
    for path in sorted(package.rglob("*.py")):
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names |= {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
            names |= {"pickle"} if isinstance(node, ast.keyword) and node.arg == "allow_pickle" else set()
        if {name.partition(".")[0] for name in names} & _UNPICKLING:
            found.append(path.relative_to(package).as_posix())
    return [name for name in found if name not in MACHINE_CODE]


def _craft(folder: Path, key: str, way: str, evil: _Evil) -> None:
    """Put a pickle into a folder that a run of 40 frames left."""
    file, data = folder / "frames.kinefit", pickle.dumps(evil)
    whole = file.read_bytes()
    if way == "an array of objects":
        np.save(folder / "objects.npy", np.array([evil], object), allow_pickle=True)
        (folder / "objects.npy").replace(file)
    elif way == "files of former versions":
        for name in ("person.kept", "frames.kept", "results.bin", "measurements.bin", "leftovers.bin"):
            (folder / name).write_bytes(data)
    elif way == "rows of the table":
        (folder / "so-far.csv").write_bytes(b"frame,time [s],quality," + data)
    elif way.startswith("with a checksum"):
        with Checkpoint(folder, key) as checkpoint:
            frames = checkpoint.frames
            frames._records.append(data, FRAME if way.endswith("frame") else STATE, 0)
            if way.endswith("frame"):
                frames.keep(41, frames.state)
    else:
        start = {"in place of all": 0, "after the head": len(FORMAT) + 65, "after all": len(whole)}[way]
        file.write_bytes(whole[:start] + data)


WAYS = (
    "in place of all", "after the head", "after all", "with a checksum as a frame", "with a checksum as a state",
    "an array of objects", "files of former versions", "rows of the table",
)  # fmt: skip


def _ran_and_wrong(take: Take, work: Path) -> tuple[int, int]:
    """Of the `WAYS`: how many ran something, how many did not give the same motion in the end."""
    folder, evil, key = work / "unfinished", _Evil(work / "ran"), key_of(take)
    with Checkpoint(folder, key) as checkpoint:
        truth = track_take(take, checkpoint=checkpoint)[0].angles
    shutil.copytree(folder, work / "left")
    ran = wrong = 0
    for way in WAYS:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(work / "left", folder)
        _craft(folder, key, way, evil)
        evil.file.unlink(missing_ok=True)
        same = False
        for _ in range(2):  # after an error all begins anew
            try:
                with Checkpoint(folder, key) as checkpoint:
                    print(f"  {way}: {'; '.join(checkpoint.said())}")
                    same = np.array_equal(track_take(take, checkpoint=checkpoint)[0].angles, truth)
                break
            except KinefitError as error:
                print(f"  {way}: {error}")
        ran, wrong = ran + evil.file.exists(), wrong + (not same)
    return ran, wrong


def _survives(take: Path, whole: Path, out: Path, seconds: float, rng: random.Random) -> bool:
    """Kill a run at a random moment, go on, and compare with one that was not killed."""
    frames, by_clock, left = out / "unfinished" / "frames.kinefit", rng.random() < 0.5, None
    while left is None:
        shutil.rmtree(out, ignore_errors=True)
        share, began = rng.random(), time.monotonic()
        process = subprocess.Popen(command(take, out, *_OPTIONS), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None:
            size = frames.stat().st_size if frames.exists() else 0
            if (time.monotonic() - began) / seconds > share if by_clock else size / (_BYTES * _FRAMES) > share:
                process.kill()
                process.wait()
                left = size
            time.sleep(0.002)
    tracked(take, out, *_OPTIONS)
    same = same_results(whole, out) and not frames.parent.exists()
    how = "the clock" if by_clock else "size"
    print(f"  killed by {how} with {left} bytes of frames: {'equal' if same else 'different'}", flush=True)
    return same


def run() -> None:
    """Print what crafted folders run, how many kills are survived, and memory."""
    with tempfile.TemporaryDirectory() as name:
        work, rng = Path(name), random.Random(0)
        (work / "crafted").mkdir()
        ran, wrong = _ran_and_wrong(read_take(write_long_take(work / "crafted" / "take", 40)), work / "crafted")
        modules = unpickling_modules()
        print(f"  modules that could unpickle: {', '.join(modules) or 'none'}")
        figure("faults_folder_classes", ran + len(modules), "", "== 0")
        figure("faults_folder_crafted_wrong", wrong, f"of {len(WAYS)}", "== 0")
        take, whole, began = write_long_take(work / "take", _FRAMES), work / "whole", time.monotonic()
        tracked(take, whole, *_OPTIONS)
        seconds, kills = time.monotonic() - began, amount(KILLS, 1)
        equal = sum(_survives(take, whole, work / f"kill-{k}", seconds, rng) for k in range(kills))
        figure("faults_folder_kills", equal, f"of {kills}", f"== {kills}")
        memory = None if quick() else tracked(write_long_take(work / "long", LONG), work / "long-out")[1]
        figure("faults_folder_memory", memory, "MB", "<= 500", LEFT_OUT)
