"""Flat valleys of the cost in `kinefit markers fit`: jumps from frame to frame, and the bars that deny them.

A jump is a step of an angle that departs by more than 10° from the mean of the two steps before and the two after it.
It is covered where the stated deviations of its two frames allow it within two sigma. Labels that are known to be wrong
are put right first.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.markers.markers_audit import CLEAN, FLIP, clean
from benchmarks.figures import amount, figure
from benchmarks.scenes.motions import library
from kinefit import Markers, Motion, fit_marker_subject, fit_markers, load_body
from kinefit.bodies import BodyState
from kinefit.bodies.marker_sets import placement
from kinefit.fitting.markers.subject import columns
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solving.trajectory.sequence import fit_sequence

DROP_JUMP = "markers/nimblephysics/data__grf__Subject4__MarkerData__DJ1.trc"
SQUATS = "markers/nimblephysics/data__grf__Subject4__MarkerData__squats1.trc", 680
NO_SET = "markers/btkdata/Input__C3DSamples__c3d.org__sample01__Eb015pr.c3d"  # no marker set explains its labels
TAKES = (
    *(name for name in CLEAN if name != NO_SET), FLIP, "markers/nimblephysics/data__c3d__nick_freeform_001.c3d",
    *(f"forces_nimblephysics/subject4/{name}.trc" for name in ("DJ2", "STSweakLegs1", "walking2", "walkingTO1")),
    *(f"forces_nimblephysics/opencap/{name}.trc" for name in ("DJ1", "walking2")),
)  # fmt: skip
TRUNK = "lumbar_extension", "thorax_extension"
JUMP = np.radians(10.0)
OFFSET, NOISE = 0.005, 0.002  # [m] of simulated markers: constant, and anew in every frame


def jumps(motion: Motion) -> tuple[NDArray, NDArray]:
    """(F - 1, D) bool: steps that are jumps, and those that the stated deviations do not cover."""
    steps, std = np.diff(motion.angles, axis=0), motion.dof_std[:, 6:]
    padded = np.pad(steps, ((2, 2), (0, 0)), mode="edge")
    count = len(steps)
    off = np.abs(steps - np.mean([padded[k : k + count] for k in (0, 1, 3, 4)], axis=0))
    jump = (off > JUMP) & ~motion.body.tree.prismatic
    return jump, jump & (off > 2.0 * np.hypot(std[1:], std[:-1]))


def rise(motion: Motion, markers: Markers, marker_set: str, sigma: NDArray, frame: int, angle: str) -> float:
    """Least rise of a frame's cost where an angle is two stated sigma off and all others are fitted anew."""
    body, state, d = motion.body, motion.state(frame), motion.body.tree.coordinates.index(angle)
    points = body.markers(marker_set)
    x, locked = columns(markers, points.names)[[frame]], np.zeros(body.tree.n_dofs, bool)

    def cost(step: float) -> float:
        start = BodyState(state.T_world_root, state.angles + step * (np.arange(len(state.angles)) == d))
        return float(
            fit_sequence(body, start, points, x, sigma=sigma, loss=MARKER_LOSS, locked=locked, posture=1.0).costs[0]
        )

    least, locked[6 + d] = cost(0.0), True
    return min(cost(side * 2.0 * motion.dof_std[frame, 6 + d]) for side in (-1.0, 1.0)) - least


def simulated() -> Iterator[tuple[Motion, Motion]]:
    """Recorded motions with Stanford's markers, which leave lumbar and thorax open: truth, and what is fitted."""
    for seed, truth in enumerate(library().values()):
        rng, placed = np.random.default_rng(seed), placement(truth.body, "STANFORD_47")
        shape = len(truth), len(placed.points), 3
        x = truth.positions(placed.points) + rng.normal(0, OFFSET, shape[1:]) + rng.normal(0, NOISE, shape)
        body = replace(truth.body, marker_sets={**truth.body.marker_sets, placed.name: placed.points})
        markers = Markers(placed.points.names, truth.rate, x, up=truth.up)
        yield truth, fit_markers(body, markers, placed.name, sigma=float(np.hypot(OFFSET, NOISE)))


def run() -> None:
    """Print jumps of all takes, one line each, and coverage of simulated ones."""
    count, outside, trunk_outside, takes, seconds, frames = 0, 0, 0, 0, 0.0, 0
    for name in TAKES[: amount(None, 1)]:
        markers = clean(name)
        if markers is None:
            continue
        subject = fit_marker_subject(load_body("humanoid"), markers)
        began = time.process_time()
        motion = fit_markers(subject, markers)
        seconds, frames, takes = seconds + time.process_time() - began, frames + len(motion), takes + 1
        trunk = [motion.body.tree.coordinates.index(angle) for angle in TRUNK]
        jump, uncovered = jumps(motion)
        count, outside = count + int(jump.sum()), outside + int(uncovered.sum())
        trunk_outside += int(uncovered[:, trunk].sum())
        where = {motion.body.tree.coordinates[d]: int(n) for d, n in enumerate(uncovered.sum(axis=0)) if n}
        print(f"# {name.rpartition('/')[2]}: {jump.sum()} jumps, {uncovered.sum()} outside {where or ''}", flush=True)
        if name == DROP_JUMP:
            step = np.abs(np.diff(motion.angles[:, trunk], axis=0))
            worst = int(step.max(axis=1).argmax())
            std = np.degrees(motion.dof_std[worst, 6:][trunk])
            print(f"# drop jump: largest step behind frame {worst}, stated {std[0]:.1f} and {std[1]:.1f}°")
            figure("jumps_drop_jump_trunk_step", np.degrees(step.max()), "° from frame to frame", "<= 10")
        if name == SQUATS[0]:
            value = rise(motion, markers, subject.marker_set, subject.sigma, SQUATS[1], TRUNK[0])
            figure("jumps_squats_rise", value, "of the cost at two stated sigma", ">= 3")
    why = "" if takes else "no recordings: set KINEFIT_DATA"
    trunk_told, told = (trunk_outside, outside) if takes else (None, None)
    figure("jumps_trunk_outside", trunk_told, f"of lumbar and thorax in {takes} takes, not covered", "== 0", why)
    figure("jumps_outside", told, f"of all {count} jumps of angles, not covered", "== 0", why)
    figure("jumps_ms_frame", 1e3 * seconds / frames if frames else None, "ms a frame", "<= 2", why)
    inside: dict[str, list[NDArray]] = {"trunk": [], "angles": []}
    for truth, motion in simulated() if takes else ():
        trunk = [motion.body.tree.coordinates.index(angle) for angle in TRUNK]
        std = motion.dof_std[:, 6:]
        off = np.abs((motion.angles - truth.angles + np.pi) % (2 * np.pi) - np.pi)
        within = np.where(np.isfinite(std), off < 2.0 * std, np.nan)
        inside["trunk"].append(within[:, trunk].ravel())
        inside["angles"].append(within.ravel())
    for key, parts in inside.items():
        share = 100 * float(np.nanmean(np.concatenate(parts))) if parts else None
        figure(f"jumps_simulated_{key}_inside", share, "% of the truth within two stated sigma", ">= 90", why)
