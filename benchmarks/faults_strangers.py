"""Code, files and clocks of strangers in folders of recordings: `python -m benchmarks.faults faults_strangers`.

Every road that starts a process runs in a folder full of files that carry the names of modules and programs. Readers,
folder searches and a batch get files whose reading has no end, damaged MATLAB files and names that are not UTF-8. Live
folders get files that carry the time of another computer's clock.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.io import savemat
from tests.strangers import ENDINGS, ROADS, code_that_runs, outcome, without_end

from benchmarks.figures import amount, figure
from kinefit.simulation import write_synthetic_take
from kinefit.studio.live.cameras import Inbox, SessionClock
from kinefit.studio.live.folders import ImageFolderStream

_COMMAND_TIMEOUT_S = 120.0  # of a command that takes some 10 s
_MAX_DELAY_S = 1.0  # of a live image: 0.05 s by design, the rest for a busy computer
_CLOCKS_S = (3600.0, 86400.0, 2.0, 0.5, -3600.0, 0.0)  # that another computer is ahead


def code(folder: Path) -> list[str]:
    """Roads on which code of the folder ran."""
    found = []
    for k, road in enumerate(ROADS):
        (folder / str(k)).mkdir()
        if ran := code_that_runs(road, folder / str(k)):
            found.append(f"{road} ({', '.join(ran)})")
    return found


def endless(folder: Path) -> tuple[int, list[str]]:
    """Number of files without an end, and those that a reader does not refuse."""
    found, count = [], 0
    for reader, names in ENDINGS.items():
        for name in names:
            for kind in without_end(folder):
                place = Path(tempfile.mkdtemp(dir=folder))
                without_end(place)[kind](place / name)
                count += 1
                if "not a file" not in (said := outcome(reader, place / name)):
                    found.append(f"{reader} of a {kind} {name}: {said}")
    return count, found


def damaged_mat(folder: Path) -> tuple[int, list[str]]:
    """Number of damaged MATLAB files, and those that are neither read nor refused with a typed error."""
    path, found, count = folder / "a.mat", [], amount(60, 4)
    content = {"K": np.eye(3), "s": {"a": np.zeros((2, 3)), "n": "cam"}, "c": np.array([1, "x", [1, 2]], object)}
    for seed in range(count):
        savemat(path, content, do_compression=seed % 2 == 1)
        chosen, data = random.Random(seed), bytearray(path.read_bytes())
        for _ in range(1 + seed % 4):
            data[chosen.randrange(128, len(data))] = chosen.randrange(256)
        path.write_bytes(data)
        said = outcome("kinefit.readers.calibration.read:read_calibration", path, seconds=90)
        found += [f"MATLAB file {seed}: {said}"] if not said.startswith(("refused", "read")) else []
    return count, found


def commands(folder: Path) -> tuple[int, list[str]]:
    """Number of commands in folders with such files and names, and those that hang or end with an error of kinefit."""
    good = write_synthetic_take(folder / "good").parent
    for name in (b"r\xe9c", b"pipes"):
        shutil.copytree(good, folder / os.fsdecode(name))
    odd, pipes = folder / os.fsdecode(b"r\xe9c"), folder / "pipes"
    for name in ("cam09.mp4", "calibration_2.toml", "queue.json", "walk.c3d", "board.mat", "more.toml", "take.toml"):
        (pipes / name).unlink(missing_ok=True)
        os.mkfifo(pipes / name)
    (pipes / "depth.mcap").symlink_to("/dev/zero")
    asked = {
        "check": [odd], "track": [odd, "--no-overlays"], "init": [odd], "batch": [folder, "--no-overlays"],
        "init of pipes": [pipes, "--force"], "check of pipes": [pipes],
    }  # fmt: skip
    found = []
    for name, words in asked.items():
        line = [sys.executable, "-m", "kinefit", name.split()[0], *words]
        try:
            done = subprocess.run(line, cwd=folder, capture_output=True, timeout=_COMMAND_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            found.append(f"{name}: hangs")
            continue
        if done.returncode not in (0, 2) or b"kinefit itself" in done.stderr:
            found.append(f"{name}: exit code {done.returncode}, {done.stderr[-200:].decode('utf-8', 'replace')}")
    if not (folder / "kinefit-batch" / "summary.csv").exists():
        found.append("batch: no summary")
    return len(asked), found


def clocks(folder: Path) -> tuple[int, list[str]]:
    """Number of live images, and those that came late or not at all."""
    found, count = [], amount(10, 2)
    for ahead in _CLOCKS_S:
        place = folder / f"{ahead:g}"
        place.mkdir()
        inbox = Inbox(["cam"], patience=0.0)
        stream = ImageFolderStream("cam", place, (64, 48), SessionClock())
        stream.start(inbox)
        for k in range(count):
            cv2.imwrite(str(place / f"new_{k}.png"), np.full((48, 64, 3), 10 * k, np.uint8))
            for path in (place / f"new_{k}.png", place):
                os.utime(path, (time.time() + ahead,) * 2)
            arrived = inbox.take(_MAX_DELAY_S)
            if not any(one.seen[0, 0, 0] == 10 * k for one in arrived):
                found.append(f"image {k} of a clock {ahead:g} s ahead")
        stream.stop()
    return count * len(_CLOCKS_S), found


def run() -> None:
    with tempfile.TemporaryDirectory() as name:
        folders = [Path(name) / part for part in ("code", "endless", "mat", "commands", "clocks")]
        for folder in folders:
            folder.mkdir()
        ran = code(folders[0])
        print("code of the folder ran: " + ("; ".join(ran) or "on no road"))
        figure("faults_strangers_code", float(len(ran)), f"of {len(ROADS)} roads", "== 0")
        before = Path.cwd()
        os.chdir(folders[1])  # a socket's path is short
        counts, bad = zip(endless(folders[1]), damaged_mat(folders[2]), commands(folders[3]), strict=True)
        os.chdir(before)
        print("hang or crash: " + ("; ".join(text for part in bad for text in part) or "none"))
        figure("faults_strangers_files", float(sum(map(len, bad))), f"of {sum(counts)} files and folders", "== 0")
        count, late = clocks(folders[4])
        print("lost or late: " + ("; ".join(late) or "none"))
        figure("faults_strangers_clock", float(len(late)), f"of {count} images", "== 0")


if __name__ == "__main__":
    run()
