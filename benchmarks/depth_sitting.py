"""Sitting down before one depth camera: what depth says along the trunk's axis, and what a tracker on the body adds.

    python -m benchmarks.depth depth_sitting

P2 6: "movements along the main axis of the body (e.g. sitting down) can hardly be detected, which substantiates again
the use of different data inputs". Five people sit down and stand up again in the simulated sequences of P2's experiment
(a time-of-flight camera at 10 Hz, seeds 0 to 4). Printed are standard deviations and errors of the trunk along its axis
and across it: by the trunk's own depth points, as P2 moves each limb on its own; by P2's method; and by the tracker,
whose joints are hard, with depth alone and with a magnetic tracker on the sacrum beside it (P2-10; 5 mm, 2 degrees).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from kinefit.bodies import PointSet
from kinefit.bodies.motion import Motion
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry import se3
from kinefit.observations import BodyTrackerFrame
from kinefit.sensors.base import rows_at
from kinefit.sensors.points.body_trackers import BodyTrackerSensor
from kinefit.simulation.evaluation.sequences import TruthSequence, sequence
from kinefit.simulation.evaluation.voodoo import voodoo_method
from kinefit.simulation.movements import people
from kinefit.solving.rows import Rows

SIGMA, TURN = 0.005, np.radians(2.0)  # [m], [rad] of the tracker on the body
AXES = ("along", "across", "toward the camera")
_ALONE, _WORN = "the tracker, depth alone", "the tracker, depth and a tracker on the body"
_FREE = 1.0  # [m], [rad] of a trunk that nothing holds
_MIDDLE = 0.25  # [m] of the trunk above the middle of the hips


def directions(run: TruthSequence) -> NDArray:
    """(F, 3, 3) unit rows of each frame: along the trunk's axis, across it, and across it toward the camera."""
    along = run.truth.Ts_world_root[:, :3, 1]
    ahead = run.rig["depth"].centre_world - run.truth.Ts_world_root[:, :3, 3]
    ahead = ahead - np.sum(ahead * along, axis=1, keepdims=True) * along
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.stack([along, np.cross(along, ahead), ahead], axis=1)


def trunk_errors(run: TruthSequence, motion: Motion) -> NDArray:
    """(F, 3) [m] signed errors of the trunk's middle in its true directions."""
    middle = PointSet(("trunk",), np.zeros(1, int), np.array([[0.0, _MIDDLE, 0.0]]))
    off = motion.positions(middle)[:, 0] - run.truth.positions(middle)[:, 0]
    return np.asarray(np.einsum("fki,fi->fk", directions(run), off))


def tracked(run: TruthSequence, worn: bool, seed: int) -> tuple[Motion, NDArray]:
    """The smoothed motion, and (F, 3) [m] deviations of the trunk by its own depth points in its directions."""
    random, body, to = np.random.default_rng([seed, 99]), run.truth.body, directions(run)
    sensor = BodyTrackerSensor("magnetic", {"sacrum": "torso"}, sigma=SIGMA, rotation_sigma=TURN)
    tracker = Tracker(body, run.rig, rate=run.truth.rate, sigma=run.sigma, keep=True, up="y", sensors=[sensor])
    tracker.start_at(run.truth.state(0))
    own = []
    for i, depth in enumerate(run.depth):
        T = run.truth.Ts_world_root[i]
        x, R = T[:3, 3] + SIGMA * random.normal(size=3), T[:3, :3] @ se3.exp_so3(TURN * random.normal(size=3))
        magnetic = BodyTrackerFrame("magnetic", depth.time, ("sacrum",), x[None], R[None])
        result = tracker.update([depth, magnetic] if worn else [depth])
        assert result is not None
        scene = tracker.scene_of(result.state, result.time)
        H, middle = np.eye(6) / _FREE**2, T[:3, :3] @ np.array([0.0, _MIDDLE, 0.0]) + T[:3, 3]
        made = [r for m in result.matched if m.sensor == "depth" for r in rows_at(m, scene)]
        for rows in (r for r in made if isinstance(r, Rows)):
            of = rows.segment == 0
            a = np.c_[rows.direction, np.cross(rows.point - middle, rows.direction)][of]
            H += a.T @ (rows.weight[of, None] * a)
        own.append(np.sqrt(np.einsum("ki,ij,kj->k", to[i], np.linalg.inv(H)[:3, :3], to[i])))
    return tracker.motion(name=run.truth.name), np.array(own)


def run() -> None:
    """Print the figures."""
    trunk, errors, stds = [], dict[str, list[NDArray]](), dict[str, list[NDArray]]()
    for seed in range(amount(5, 1)):
        seen = sequence("sit_down", people(seed=seed)[seed], seed=seed)
        method = voodoo_method(seen, "3d", seen.truth.state(0))
        errors.setdefault("P2's method, depth alone", []).append(trunk_errors(seen, method))
        for worn, label in ((False, _ALONE), (True, _WORN)):
            motion, own = tracked(seen, worn, seed)
            errors.setdefault(label, []).append(trunk_errors(seen, motion))
            stds.setdefault(label, []).append(motion.dof_std[:, [1, 2, 0]])
            trunk += [] if worn else [own]
    alone = 1e3 * np.median(np.concatenate(trunk), axis=0)
    told = ", ".join(f"{n} {s:.1f}" for n, s in zip(AXES, alone))
    print(f"the trunk by its own depth points: sigma {told} mm", flush=True)
    rms = {label: 1e3 * np.sqrt(np.mean(np.concatenate(part) ** 2, axis=0)) for label, part in errors.items()}
    for label, off in rms.items():
        each = ", ".join(f"{n} {e:.1f}" for n, e in zip(AXES, off))
        if label in stds:
            bars = 1e3 * np.median(np.concatenate(stds[label]), axis=0)
            each += "; sigma " + ", ".join(f"{n} {b:.1f}" for n, b in zip(AXES, bars))
        print(f"{label}: RMS error of the trunk {each} mm", flush=True)
    figure("sitting_trunk_ratio", alone[0] / alone[2], "times the deviation along the trunk's axis of that toward the "
           "camera, its own depth points", ">= 3")  # fmt: skip
    figure("sitting_depth_mm", rms[_ALONE][0], "mm along the trunk's axis, depth alone", "<= 20")
    figure("sitting_worn_mm", rms[_WORN][0],
           "mm along the trunk's axis, with a tracker on the body", "<= 5")  # fmt: skip


if __name__ == "__main__":
    run()
