"""Points of a drawn arm that vanish: found again, under their names, where the body's motion says (P4-11).

The arm of `surface_body` before its cameras, through `kinefit surface`, `kinefit track`, and `kinefit surface --motion`
with what that found. Counted are points that were lost and whose place on the arm is, by the truth, seen by every
camera at 65 degrees or steeper three frames or more later. A return is false where the point is more than 2 mm from its
place. Without the motion none keeps its name: new points are made there. Settings were chosen on seed 10.
When a point comes back: the first frame in which the true motion turns its place to every camera, of points that were
turned away for a frame or more, less the frame that `returns.csv` says.
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.surfaces.surface_body import cameras, frames_of, moving_arm, record
from benchmarks.commands import printed
from benchmarks.figures import amount, figure
from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces.places import nearest
from kinefit.geometry.camera import Rig

AGAIN, STEEP, FALSE = 3, np.cos(np.radians(65.0)), 0.002
FACING = 0.25  # cosine as of `photogrammetry.returning`
SOON = 2  # frames


def run() -> None:
    """Print the figures."""
    told, late = [], []
    for seed in (12, 13)[: amount(2, 1)]:
        with tempfile.TemporaryDirectory() as place:
            counted, frames = counts(Path(place), seed, frames=amount(40, 6), size=amount(640, 320))
            told.append(counted)
            late += frames
    without, due, found, false = np.sum(told, axis=0)
    print(f"# {due} points came into view again, {found} found under their names, {false} wrong; {without} without")
    figure("surface_return_without", 100 * without / max(due, 1), "% of points found again, without the motion", "<= 1")
    figure("surface_return_found", 100 * found / max(due, 1), "% of points found again", ">= 50")
    figure("surface_return_false", 100 * false / max(found, 1), "% of these more than 2 mm off", "<= 1")
    soon = 100 * float(np.mean(np.abs(late) <= SOON)) if late else None
    middle = float(np.median(late)) if late else np.nan
    print(f"# {len(late)} points were turned away and came back; said less true frame, median {middle:.0f}")
    figure("surface_return_when", soon, f"% within {SOON} frames of the true time", ">= 90", "" if late else "none")


def counts(
    folder: Path, seed: int, *, frames: int, size: int
) -> tuple[tuple[int, int, int, int], list[float]]:
    """Found again without the motion; that could be, that were, that were wrong, with it; and how late, in frames."""
    motion, rig = moving_arm(seed, frames), cameras(size)
    record(folder, motion, rig, seed)
    surface = ["surface", folder / "calib.toml", *(f"{c.name}={folder / c.name}.avi" for c in rig)]
    printed(*surface, "-o", folder / "surface")
    printed("track", folder / "take.toml", "-o", folder / "result")
    printed(*surface, "-o", folder / "again", "--motion", folder / "result")
    without = returns(paths_of(folder / "surface" / "trajectories.csv", motion), motion, rig)
    paths = paths_of(folder / "again" / "trajectories.csv", motion)
    late = lateness(folder / "again" / "returns.csv", paths, motion, rig)
    return (without[1], *returns(paths, motion, rig)), late


def lateness(file: Path, paths: NDArray, motion: Motion, rig: Rig) -> list[float]:
    """Frame in which each point comes back as a table says, less the true one; infinite where it says none."""
    frames, out = _frames(motion), list[float]()
    with file.open() as lines:
        rows = [{k: float(v) * motion.rate if v else np.inf for k, v in row.items()} for row in csv.DictReader(lines)]
    for row in rows:
        point, lost = round(row["point"] / motion.rate), round(row["lost_s"])
        if point >= paths.shape[1] or not np.isfinite(paths[lost - 1, point]).all():
            continue  # its path was cut off by the filters
        seen, _, on = in_view(motion, rig, frames, lost - 1, paths[lost - 1, point][None], FACING)
        if not on.all() or seen[lost, 0] or not seen[lost:, 0].any():
            continue
        out.append(row["expected_s"] - (lost + int(np.argmax(seen[lost:, 0]))))
    return out


def _frames(motion: Motion) -> NDArray:
    return np.stack([frames_of(motion, motion.state(k)) for k in range(len(motion))])


def in_view(
    motion: Motion, rig: Rig, frames: NDArray, k: int, x_world: NDArray, cosine: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Which points (N, 3) of frame k every camera sees at least so steeply, (F, n); where they are, (F, n, 3).

    And which of the points are on the body (N,): the n that the others count.
    """
    near = nearest(motion.body, motion.state(k), x_world, max_distance=0.02)
    on = near.segment >= 0
    s = near.segment[on]
    R, t = frames[k, s, :9].reshape(-1, 3, 3), frames[k, s, 9:]
    rest = np.einsum("nji,nj->ni", R, x_world[on] - t)
    out = np.einsum("nji,nj->ni", R, near.normal[on])
    turns, t = frames[:, s, :9].reshape(len(frames), -1, 3, 3), frames[:, s, 9:]
    x, n = np.einsum("fnij,nj->fni", turns, rest) + t, np.einsum("fnij,nj->fni", turns, out)
    to = [camera.centre_world - x for camera in rig]
    seen = np.all([np.sum(n * v, axis=2) > cosine * np.linalg.norm(v, axis=2) for v in to], axis=0)
    return seen, x, on


def paths_of(file: Path, motion: Motion) -> NDArray:
    """(F, P, 3) [m] of a table of paths; NaN where a point is not there."""
    ids, x = read_paths(file, len(motion), motion.rate)
    out = np.full((len(motion), ids.max() + 1, 3), np.nan)
    out[:, ids] = x
    return out


def read_paths(file: Path, count: int, rate: float) -> tuple[NDArray, NDArray]:
    """Points of a table of paths by their ids (P,), and their places (F, P, 3) [m], NaN where a point is not there."""
    with file.open() as lines:
        rows = [[row[name] for name in ("time_s", "point", "x", "y", "z")] for row in csv.DictReader(lines)]
    table = np.array(rows, float).reshape(-1, 5)
    ids, column = np.unique(table[:, 1].astype(int), return_inverse=True)
    x = np.full((count, len(ids), 3), np.nan)
    x[np.rint(table[:, 0] * rate).astype(int), column] = table[:, 2:]
    return ids, x


def returns(paths: NDArray, motion: Motion, rig: Rig) -> tuple[int, int, int]:
    """Points that vanish and whose place comes into view again, those found again, those of them that are wrong."""
    live = np.isfinite(paths[..., 0])
    due, found, false = 0, 0, 0
    frames = _frames(motion)
    for k in range(len(motion) - AGAIN):
        lost = np.flatnonzero(live[k] & ~live[k + 1])
        if not len(lost):
            continue
        seen, x, on = in_view(motion, rig, frames, k, paths[k, lost], STEEP)
        lost = lost[on]
        off = np.where(live[:, lost], np.linalg.norm(paths[:, lost] - x, axis=2), np.inf)
        again = seen[k + AGAIN :].any(axis=0)
        back = live[k + 2 :, lost].any(axis=0)
        first = k + 2 + np.argmax(live[k + 2 :, lost], axis=0)
        due += int(again.sum())
        found += int((again & back).sum())
        false += int((again & back & (off[first, np.arange(len(lost))] > FALSE)).sum())
    return due, found, false
