"""Points without names: learn a subject's markers from one labelled take, name another take's, fit a body to them.

    python examples/05_markers.py                            simulated
    python examples/05_markers.py labelled.c3d points.c3d    your own
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import kinefit


def simulated(frames=120, seed=0):
    """Markers of squats and waves with 1 mm noise, and the same without names, in another order, with ghosts."""
    truth, rng = kinefit.simulation.squat_and_wave(rate=60), np.random.default_rng(seed)
    points = kinefit.bodies.placement(truth.body, "CMU_41").points
    points = replace(points, points=points.points + 0.01 * rng.standard_normal((len(points), 3)))  # no two sides alike
    x = truth.positions(points) + 0.001 * rng.standard_normal((len(truth), len(points), 3))
    labelled = kinefit.Markers(points.names, truth.rate, x, up=truth.up)
    order = rng.permutation(len(points))
    seen = np.concatenate([x[:frames, order], x[:frames, :2] + (0.3, 0.2, 0.1)], axis=1)
    seen[40:60, :3] = np.nan
    names = tuple(f"*{i + 1}" for i in range(seen.shape[1]))
    return labelled, kinefit.Markers(names, truth.rate, seen, up=truth.up)


def main(labelled=None, points=None, out="kinefit-example"):
    """Returns the identification and the motion."""
    if labelled and points:
        taught, take = kinefit.read_markers(labelled), kinefit.read_markers(points)
    else:
        taught, take = simulated()

    model = kinefit.learn_model(taught, name="subject")
    for finding in kinefit.markers.training_gate(taught, model):  # what the training left open, and what to record
        print(f"training: {finding}")

    found = kinefit.identify_take(model, take)
    named = found.markers(take)
    share = 100 * (found.column >= 0).mean()
    print(f"{len(take)} frames: {share:.1f} % of the labels named, {found.ghosts} points are unassigned")
    for doubt in found.doubts[:5]:
        print(f"look at {doubt.text}")

    # Size of the body and place of each marker from all frames together, then the angles of every frame.
    subject = kinefit.fit_marker_subject(kinefit.load_body("humanoid"), named)
    motion = kinefit.fit_markers(subject, named)
    off = motion.residuals["markers"].norms
    print(f"body {subject.body.stature:.2f} m tall, markers {1e3 * np.nanmedian(off):.1f} mm off in the median")
    for name in ("hip_flexion_r", "knee_angle_r", "elbow_flex_r"):
        angle = np.degrees(motion.angles[:, motion.body.tree.coordinate(name)])
        print(f"{name}: {angle.min():.0f} to {angle.max():.0f} deg")

    Path(out).mkdir(parents=True, exist_ok=True)
    kinefit.exporters.write_markers(named, Path(out) / "labelled.c3d")
    kinefit.exporters.write_osim(subject.body, Path(out) / "body.osim")
    kinefit.exporters.write_mot(motion, Path(out) / "motion.mot")
    print(f"written: {out}/labelled.c3d, body.osim, motion.mot")
    return found, motion


if __name__ == "__main__":
    main(*sys.argv[1:])
