"""The balancing trial with and without silhouettes beside its keypoints (for `mixed`): none may harm.

Four cameras, 100 frames; every take goes through `kinefit.track_take` with its defaults, once with the keypoints of a
detector, once with masks of the same cameras beside them. Residuals are taken here, in the same way of both: the
fitted body's points projected into the calibration's image, against the points of the person that most cameras agree
on; left or right, whichever is nearer, as MediaPipe swaps them in cam02; the median over cameras, frames and points.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.images.silhouettes_track import overlaps
from benchmarks.figures import NotMeasured, data, figure
from benchmarks.scenes.balancing import CAMERAS, TRIAL, masks_of, trial_text
from benchmarks.scenes.takes import tracked
from kinefit import Keypoints, Motion, Rig
from kinefit.errors import KinefitError
from kinefit.fitting.multiview.association import choose_people
from kinefit.sensors.channels import mirror_name

QUICK, SWAPS = 6, 32
DETECTORS = ("openpose", "mediapipe")


def take_text(folder: Path, detector: str, silhouettes: bool, cameras: Sequence[str] = CAMERAS, frames: int = 0) -> str:
    """The trial by keypoints of some cameras, with or without their masks; its first frames only, where so many."""
    beside = {camera: masks_of(folder, camera) if silhouettes else "" for camera in cameras}
    return trial_text(folder, beside, detector=detector, head=f"frames = [0, {frames}]\n" if frames else "")


def residuals(motion: Motion, rig: Rig, keypoints: Sequence[Keypoints], people: Sequence[NDArray]) -> NDArray:
    """(C, F, K) [px] of a detector's points, NaN where it saw none or the body has none."""
    out = []
    for seen, chosen in zip(keypoints, people):
        points = motion.body.keypoints(seen.keypoint_set)
        columns = [seen.names.index(name) for name in points.names]
        other = [
            seen.names.index(mirror_name(name) if mirror_name(name) in seen.names else name) for name in points.names
        ]
        fitted = rig[seen.camera].project(motion.positions(points))
        measured = seen.points[np.arange(len(seen)), np.maximum(chosen, 0)][: len(motion)]
        off = [np.linalg.norm(measured[:, c] - fitted, axis=-1) for c in (columns, other)]
        off = [np.where((chosen[: len(motion)] >= 0)[:, None], o, np.nan) for o in off]
        swapped = _median(off[1]) < _median(off[0])
        out.append(np.where(swapped[:, None], off[1], off[0]))
    return np.array(out)


def _median(off: NDArray) -> NDArray:
    """(F,) of the points (F, K) that were seen; infinite where none was."""
    none = np.isnan(off).all(axis=1)
    return np.where(none, np.inf, np.nanmedian(np.where(none[:, None], 0.0, off), axis=1))


def run(quick: bool = False) -> None:
    """Print the figures; quickly, of a few frames and one camera held out."""
    folder, frames = data(TRIAL), QUICK if quick else 0
    goals = [("real_residual_openpose", "x", "<= 1.05"), ("real_residual_mediapipe", "x", "<= 1.05"),
             ("real_iou", "", ">= 0.90"), ("real_held_out", "x", "<= 1"),
             ("real_swaps", "frames", f">= {SWAPS}")]  # fmt: skip
    if folder is None:
        raise NotMeasured("the real trial is absent")
    values: dict[str, float] = {}
    reasons: dict[str, str] = {}
    for detector in DETECTORS:
        try:
            values |= both(folder, detector, frames, quick)
        except KinefitError as error:
            reasons |= {name: str(error) for name, _, _ in goals if name not in values}
    if quick:
        values.pop("real_swaps", None)
        reasons["real_swaps"] = "its frames are not all among the first frames"
    for name, unit, goal in goals:
        figure(name, values.get(name), unit, goal, reasons.get(name, ""))


def both(folder: Path, detector: str, frames: int, quick: bool) -> dict[str, float]:
    """Figures of one detector."""
    (alone, seen), (beside, masked) = (tracked(take_text(folder, detector, s, frames=frames)) for s in (False, True))
    assert seen.rig is not None
    rig, keypoints = seen.rig, seen.keypoints
    people = choose_people(rig, keypoints)
    off = [float(np.nanmedian(residuals(motion, rig, keypoints, people))) for motion in (alone, beside)]
    print(f"# {detector}: residual {off[0]:.2f} px, with silhouettes {off[1]:.2f} px", flush=True)
    out = {f"real_residual_{detector}": off[1] / off[0]}
    if detector == "mediapipe":
        counts = [{n: int(r.swapped.sum()) for n, r in m.residuals.items() if r.unit == "px"} for m in (alone, beside)]
        print(f"# swapped frames by keypoints alone {counts[0]}, with silhouettes {counts[1]}", flush=True)
        return out | {"real_swaps": float(counts[1].get("cam02", 0))}
    shares = [overlaps(motion, rig, masked.silhouettes) for motion in (alone, beside)]
    for motion, share in zip(("keypoints alone", "with silhouettes"), shares):
        print(
            f"# IoU {motion}: {share.mean():.3f}, by camera {np.round(share.mean(axis=0), 3)}, worst {share.min():.3f}"
        )
    held: list[list[float]] = []
    for k, camera in enumerate(CAMERAS[: 1 if quick else None]):
        others = [name for name in CAMERAS if name != camera]
        fits = [tracked(take_text(folder, detector, s, others, frames))[0] for s in (False, True)]
        held.append([float(np.nanmedian(residuals(m, rig, keypoints[k : k + 1], people[k : k + 1]))) for m in fits])
        print(f"# {camera} held out: {held[-1][0]:.2f} px, with silhouettes {held[-1][1]:.2f} px", flush=True)
    means = np.mean(held, axis=0)
    return out | {"real_iou": float(shares[1].mean()), "real_held_out": float(means[1] / means[0])}
