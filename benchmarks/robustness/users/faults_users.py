"""OpenSim's inverse kinematics on what `kinefit markers fit` writes, beside kinefit's own fit, for every marker set."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.figures import LEFT_OUT, amount, figure, peers, quick
from benchmarks.peers.environments import run_peer
from kinefit.bodies import PointSet
from kinefit.bodies.marker_sets import placed_set_names, placement
from kinefit.cli.markers._fit import fit_file
from kinefit.exporters import write_markers
from kinefit.observations import Markers
from kinefit.simulation import squat_and_wave


def write_take(path: Path, name: str) -> None:
    """A squat with a marker set, each marker 8 mm and 2 mm of noise off the set's place along each axis."""
    truth, rng = squat_and_wave(rate=float(amount(15, 5))), np.random.default_rng(0)
    points = placement(truth.body, name).points
    away = rng.normal(scale=0.008, size=(len(points), 3))
    x = truth.positions(PointSet(points.names, points.segments, points.points + away))
    x = x + rng.normal(scale=0.002, size=x.shape)
    write_markers(Markers(points.names, truth.rate, x, up=truth.up), path)


def run() -> None:
    """Print how far OpenSim's marker error is from kinefit's, worst of all marker sets."""
    worst, reason = None, ""
    with tempfile.TemporaryDirectory() as place:
        folder, own = Path(place), {}
        for name in placed_set_names():
            write_take(folder / f"{name}.trc", name)
            formats = ("mot", "osim", "markers")
            ((motion, _),) = fit_file(folder / f"{name}.trc", folder / name, formats=formats).values()
            own[name] = 1e3 * float(np.sqrt(np.mean(motion.residuals["markers"].norms ** 2)))
        left_out = {"reason": LEFT_OUT if quick() else "--no-peers"}
        found = run_peer("opensim_sets", folder) if peers() else left_out
        reason = found.get("reason", "")
        if not reason:
            apart = {n: [abs(found[n][key] - own[n]) for key in ("rms_mm", "own_angles_mm")] for n in own}
            for name, (solved, same) in apart.items():
                print(f"# {name}: {own[name]:.2f} mm; OpenSim off by {solved:.2f}, at kinefit's angles {same:.4f}")
            worst = max(map(max, apart.values()))
    figure("faults_users_osim_rms", worst, "mm", "<= 0.5", reason)
