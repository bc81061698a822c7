"""Points of a drawn arm that vanish: found again, under their names, where the body's motion says (P4-11).

The arm of `surface_body` before its cameras, through `kinefit surface`, `kinefit track`, and `kinefit surface --motion`
with what that found. Counted are points that were lost and whose place on the arm is, by the truth, seen by every
camera at 65 degrees or steeper three frames or more later. A return is false where the point is more than 2 mm from its
place. Without the motion none keeps its name: new points are made there. Settings were chosen on seed 10.
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.surface_body import cameras, frames_of, moving_arm, record
from kinefit.bodies.surfaces import nearest
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion

AGAIN, STEEP, FALSE = 3, np.cos(np.radians(65.0)), 0.002


def run() -> None:
    """Print the figures."""
    told = []
    for seed in (12, 13)[: amount(2, 1)]:
        with tempfile.TemporaryDirectory() as place:
            told.append(counts(Path(place), seed, frames=amount(40, 6), size=amount(640, 320)))
    without, due, found, false = np.sum(told, axis=0)
    print(f"# {due} points came into view again, {found} found under their names, {false} wrong; {without} without")
    figure("surface_return_without", 100 * without / max(due, 1), "% of points found again, without the motion", ">= 0")
    figure("surface_return_found", 100 * found / max(due, 1), "% of points found again", ">= 50")
    figure("surface_return_false", 100 * false / max(found, 1), "% of these more than 2 mm off", "<= 1")


def counts(folder: Path, seed: int, *, frames: int, size: int) -> tuple[int, int, int, int]:
    """Found again without the motion; that could be, that were, that were wrong, with it."""
    from kinefit.cli import main

    motion, rig = moving_arm(seed, frames), cameras(size)
    record(folder, motion, rig, seed)
    surface = ["surface", str(folder / "calib.toml"), *(f"{c.name}={folder / c.name}.avi" for c in rig)]
    for words in (
        [*surface, "-o", str(folder / "surface")],
        ["track", str(folder / "take.toml"), "-o", str(folder / "result")],
        [*surface, "-o", str(folder / "again"), "--motion", str(folder / "result")],
    ):
        told = CliRunner().invoke(main, words)
        if told.exit_code:
            raise RuntimeError(told.output)
    without = returns(paths_of(folder / "surface" / "trajectories.csv", motion), motion, rig)
    return without[1], *returns(paths_of(folder / "again" / "trajectories.csv", motion), motion, rig)


def paths_of(file: Path, motion: Motion) -> NDArray:
    """(F, P, 3) [m] of a table of paths; NaN where a point is not there."""
    with file.open() as lines:
        rows = [[row[name] for name in ("time_s", "point", "x", "y", "z")] for row in csv.DictReader(lines)]
    table = np.array(rows, float)
    out = np.full((len(motion), int(table[:, 1].max()) + 1, 3), np.nan)
    out[np.rint(table[:, 0] * motion.rate).astype(int), table[:, 1].astype(int)] = table[:, 2:]
    return out


def returns(paths: NDArray, motion: Motion, rig: Rig) -> tuple[int, int, int]:
    """Points that vanish and whose place comes into view again, those found again, those of them that are wrong."""
    live = np.isfinite(paths[..., 0])
    due, found, false = 0, 0, 0
    frames = np.stack([frames_of(motion, motion.state(k)) for k in range(len(motion))])
    for k in range(len(motion) - AGAIN):
        lost = np.flatnonzero(live[k] & ~live[k + 1])
        if not len(lost):
            continue
        near = nearest(motion.body, motion.state(k), paths[k, lost], max_distance=0.02)
        lost, s, normal = lost[near.segment >= 0], near.segment[near.segment >= 0], near.normal[near.segment >= 0]
        R, t = frames[k, s, :9].reshape(-1, 3, 3), frames[k, s, 9:]
        rest = np.einsum("nji,nj->ni", R, paths[k, lost] - t)
        out = np.einsum("nji,nj->ni", R, normal)
        seen, off = np.zeros((len(motion), len(lost)), bool), np.full((len(motion), len(lost)), np.inf)
        for j in range(k + 1, len(motion)):
            R, t = frames[j, s, :9].reshape(-1, 3, 3), frames[j, s, 9:]
            x, n = np.einsum("nij,nj->ni", R, rest) + t, np.einsum("nij,nj->ni", R, out)
            to = [camera.centre_world - x for camera in rig]
            seen[j] = np.all([np.sum(n * v, axis=1) > STEEP * np.linalg.norm(v, axis=1) for v in to], axis=0)
            off[j] = np.where(live[j, lost], np.linalg.norm(paths[j, lost] - x, axis=1), np.inf)
        again = seen[k + AGAIN :].any(axis=0)
        back = live[k + 2 :, lost].any(axis=0)
        first = k + 2 + np.argmax(live[k + 2 :, lost], axis=0)
        due += int(again.sum())
        found += int((again & back).sum())
        false += int((again & back & (off[first, np.arange(len(lost))] > FALSE)).sum())
    return due, found, false


if __name__ == "__main__":
    run()
