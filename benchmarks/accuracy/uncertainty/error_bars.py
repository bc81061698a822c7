"""Error bars against truth: `python -m benchmarks video error_bars`.

Recorded motions of people whose bone lengths differ by 5 % from the catalogue's and whose detector points stand 8 mm
from the anatomical ones, seen by four cameras with 3 px of jitter and 2 px of drift that lasts half a second. What is
told: the share of the truth inside the stated 95 % interval, for each group of joints, over all motions.
"""

from __future__ import annotations

import numpy as np

from benchmarks.figures import amount, figure
from benchmarks.scenes.motions import library
from benchmarks.scenes.simulated import somebody, without
from kinefit import Motion, Recording, load_body, track
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.evaluation import ErrorBarCoverage, coverage_of_groups

SCENES = {
    "usual": {"outliers": 0.1, "missing": 0.1},
    "outliers_20": {"outliers": 0.2, "missing": 0.1},
    "camera_lost": {"outliers": 0.1, "missing": 0.1},  # one camera, for 30 frames
}
ACCURACY = 8.0  # [px] what a take says that tells nothing


def elbows(truth: Motion, motion: Motion) -> tuple[float, float]:
    """Share of frames in which an elbow's bars are finite, and of its coordinates that lie inside those."""
    own = [truth.body.tree.segment(f"forearm_{side}") for side in "lr"]
    turned = motion if motion.up == truth.up else motion.turned(truth.up)
    error, std = np.abs(turned.joint_centres - truth.joint_centres)[:, own], turned.joint_std[:, own]
    finite = np.isfinite(std)
    return float(finite.all(axis=2).mean()), float(np.mean(error[finite] <= 1.96 * std[finite]))


def scene(
    name: str, keypoint_set: str, motions: dict[str, Motion]
) -> tuple[dict[str, ErrorBarCoverage], list[tuple[float, float]]]:
    """Coverage of each group of joints over all motions, and what `elbows` gives for each motion."""
    of_elbows = []
    told: dict[str, list[tuple[float, float]]] = {}
    for number, truth in enumerate(motions.values()):
        random = np.random.default_rng(number)
        truth = somebody(truth, keypoint_set, random)
        rig = studio_rig(truth)
        seen = simulate_keypoints(
            truth, rig, keypoint_set, noise_px=3.0, drift_px=2.0, drift_time=0.5, seed=number, **SCENES[name]
        )
        if name == "camera_lost":
            middle = len(truth) // 2
            lost = number % len(rig)
            seen[lost] = without(seen[lost], slice(middle - 15, middle + 15))
        recording = Recording.of_keypoints(rig, seen, sigma=ACCURACY, up=truth.up)
        motion = track(recording, load_body("humanoid"))
        of_elbows.append(elbows(truth, motion))
        for group, share in coverage_of_groups(truth, motion).items():
            told.setdefault(group, []).append((share.joints, share.angles))
    groups = {group: ErrorBarCoverage(*(mean(column) for column in zip(*shares))) for group, shares in told.items()}
    return groups, of_elbows


def mean(shares: tuple[float, ...]) -> float:
    """Of those that are known; NaN where none is."""
    known = [s for s in shares if np.isfinite(s)]
    return float(np.mean(known)) if known else float("nan")


def run() -> None:
    """Print coverage of every scene."""
    motions, of_elbows = library(), list[tuple[float, float]]()
    absent = "the recorded motions are absent"
    for keypoint_set in amount(("BODY_25B", "MEDIAPIPE_33"), ("BODY_25B",)):
        for name in amount(tuple(SCENES), ("camera_lost",)):
            tag = f"{name}_{keypoint_set.lower()}"
            told, of_scene = scene(name, keypoint_set, motions) if motions else ({}, [])
            of_elbows += of_scene
            for what in ("joints", "angles"):
                shares = {g: 100 * getattr(c, what) for g, c in told.items()}
                known = {g: s for g, s in shares.items() if np.isfinite(s)}
                print(f"# {tag}, {what}: " + ", ".join(f"{g} {s:.0f} %" for g, s in known.items()), flush=True)
                low, high = (min(known.values()), max(known.values())) if known else (None, None)
                figure(f"error_bars_{what}_{tag}_lowest", low, "%", ">= 90", absent)
                figure(f"error_bars_{what}_{tag}_highest", high, "%", "<= 98", absent)
    finite, covered = (100 * mean(column) for column in zip(*of_elbows)) if of_elbows else (None, None)
    figure("error_bars_elbows_finite", finite, "% of frames", ">= 95", absent)
    figure("error_bars_elbows_covered_least", covered, "% of coordinates in 95 % intervals", ">= 90", absent)
    figure("error_bars_elbows_covered_most", covered, "% of coordinates in 95 % intervals", "<= 98", absent)
