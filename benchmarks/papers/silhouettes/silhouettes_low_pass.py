"""Low-pass surfaces first (P1 2.4) on real images: starts that are off, by takes with `low_pass` and without.

The toy of `region_cat` in one camera, by its colour, and the balancing trial in four, by masks: each step is a take of
its own whose `[start]` is off. References: the recording's poses of the toy, and the trial's own motion.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.images.regions_cat import images, truth
from benchmarks.accuracy.images.silhouettes_track import FRAMES, take_text
from benchmarks.figures import amount, data, figure
from benchmarks.papers.silhouettes.silhouettes_cat import take_by_silhouettes
from benchmarks.papers.silhouettes.silhouettes_contour import off_by
from benchmarks.scenes.regions_scene import away
from benchmarks.scenes.takes import start_text, tracked
from kinefit.bodies.motion import Motion
from kinefit.bodies.serial import save_body
from kinefit.takes.track import track_take

TOY_OFF, PERSON_OFF = amount((20.0, 35.0, 50.0), (35.0,)), amount((20.0, 30.0), (20.0,))  # [deg]
TOY_STEPS, PERSON_STEPS = amount(range(1, 31, 2), range(1, 2)), amount(range(4, 100, 8), range(4, 5))
RIGHT_DEG, RIGHT_M = 10.0, 0.05  # of a start that is found: the toy's turn; the mean of a person's landmarks
KINDS = {"low pass": "", "plain": "low_pass = false\n"}


def run() -> None:
    """Print the share of starts that are found, and the mean difference that low-pass surfaces make, in pairs."""
    for name, recording, found in (("toy", "region_cat", _toy), ("person", "video_balancing_4cam", _person)):
        folder = data(recording)
        if folder is None:
            figure(f"low_pass_{name}_gain", None, "%", ">= 0", f"no recording {recording}")
            continue
        right = found(folder)
        for kind, shares in zip(KINDS, right.mean(axis=-1)):
            print(f"#   {name}, {kind}: found " + ", ".join(f"{100 * share:.0f} %" for share in shares))
        gain = 100 * (right[0].astype(float) - right[1]).ravel()
        error = float(np.std(gain, ddof=1) / np.sqrt(len(gain))) if len(gain) > 1 else np.nan
        figure(f"low_pass_{name}_found", 100 * float(right[0].mean()), "% of starts", ">= 40")
        figure(f"low_pass_{name}_gain", float(gain.mean()), f"% of starts, standard error {error:.1f}", ">= 0")


def _toy(folder: Path) -> NDArray:
    """(kinds, angles, steps) bool."""
    true, out = truth(folder, len(images(folder))), np.zeros((len(KINDS), len(TOY_OFF), len(TOY_STEPS)), bool)
    for a, off in enumerate(TOY_OFF):
        for k, i in enumerate(TOY_STEPS):
            start = off_by(off, true[i], np.random.default_rng([i, int(off)]))
            for kind, line in enumerate(KINDS.values()):
                with tempfile.TemporaryDirectory() as work:
                    path = take_by_silhouettes(folder, Path(work), start)
                    text = path.read_text().replace("[take]\n", f"[take]\nframes = [{i}, {i + 1}]\n", 1)
                    path.write_text(text.replace("[start]\n", f"[start]\n{line}", 1))
                    found = track_take(path)[0].Ts_world_root[0]
                out[kind, a, k] = away(found, true[i])[1] < RIGHT_DEG
    return out


def _person(folder: Path) -> NDArray:
    """(kinds, angles, steps) bool."""
    motion = tracked(take_text(folder, "masks"))[0]
    out = np.zeros((len(KINDS), len(PERSON_OFF), len(PERSON_STEPS)), bool)
    for a, off in enumerate(PERSON_OFF):
        for k, i in enumerate(PERSON_STEPS):
            swing = np.radians(off) * np.random.default_rng([i, int(off)]).choice([-1, 1], len(motion.angles[i]))
            for kind, line in enumerate(KINDS.values()):
                out[kind, a, k] = _found(folder, motion, i, motion.angles[i] + swing, line) < RIGHT_M
    return out


def _found(folder: Path, motion: Motion, i: int, angles: NDArray, line: str) -> float:
    """[m] by which the landmarks of a step are off on average, from a start with these angles [rad]."""
    body, tree, T = motion.body, motion.body.tree, motion.Ts_world_root[i]
    degrees = np.degrees(np.clip(angles, tree.lower, tree.upper))
    start = start_text(T, dict(zip(tree.coordinates, degrees)), line)
    text = take_text(folder, "masks").replace("height = 1.75\n", "size = false\n")
    text = re.sub(r"\[\[keypoints\]\]\n(.+ = .+\n)+", "", text)
    with tempfile.TemporaryDirectory() as work:
        save_body(body, Path(work) / "body.npz")
        text = text.replace("[take]\n", f'[take]\nbody = "{work}/body.npz"\n', 1)
        text = text.replace(f"frames = [0, {FRAMES}]", f"frames = [{i}, {i + 1}]", 1)
        found = tracked(text.replace("[calibration]\n", f"{start}[calibration]\n", 1))[0].state(0)
    gap = body.positions(found, body.landmarks) - body.positions(motion.state(i), body.landmarks)
    return float(np.linalg.norm(gap, axis=1).mean())
