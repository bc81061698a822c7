"""The solver beside its peers, on one humanoid, one core, the same residual: `python -m benchmarks solver`."""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, NotMeasured, amount, figure, peers, quick
from benchmarks.peers import EXCESS, write_problem
from benchmarks.peers.environments import run_peer
from benchmarks.scenes.motions import library
from benchmarks.timing import fastest
from kinefit import Motion, load_body
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.fitting.initialization.from_points import aligned_root
from kinefit.geometry.losses import geman_mcclure
from kinefit.solving import levenberg_marquardt
from kinefit.solving.correspondences import point_rows
from kinefit.solving.rows import Rows
from kinefit.solving.trajectory.sequence import Planes, SequenceFit, fit_sequence

FRAMES, NOISE, PLANES, PLANE_FRAMES = amount(500, 60), 0.002, 5000, amount(100, 10)
MOTION = "wash 02_10"
REPEATS = amount(15, 2)


def run() -> None:
    """Print every figure of the solver."""
    body = load_body("humanoid")
    motions = library(amount(None, [MOTION]))
    if MOTION not in motions:
        raise NotMeasured("the recorded motions are absent")
    motion, markers = motions[MOTION], body.markers("HANIM_45")
    rng = np.random.default_rng(0)
    x_world = motion.positions(markers)[:FRAMES] + rng.normal(0, NOISE, (FRAMES, len(markers), 3))
    planes = surface_planes(motion, rng)
    start = motion.state(0)
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), motion, markers, x_world, planes)
        beside = {}
        for peer in ("momentum", "mujoco", "mink", "pinocchio", "opensim", "momentum_planes"):
            reason = LEFT_OUT if quick() else "--no-peers"
            beside[peer] = run_peer(peer, Path(folder)) if peers() else {"reason": reason}
            print(f"# {peer}: {beside[peer]}", flush=True)

    def markers_fit(tolerance: float) -> SequenceFit:
        return fit_sequence(body, start, markers, x_world, sigma=1.0, limits=False, tolerance=tolerance)

    def robust_fit(tolerance: float) -> SequenceFit:
        return fit_sequence(body, start, markers, x_world, loss=geman_mcclure(), tolerance=tolerance)

    def planes_fit(tolerance: float) -> SequenceFit:
        return fit_sequence(body, start, planes=planes, limits=False, tolerance=tolerance)

    plain, robust, planar = least(markers_fit), least(robust_fit), least(planes_fit)
    ms, ms_robust = 1e3 * plain[0] / FRAMES, 1e3 * robust[0] / FRAMES
    ms_planes = 1e3 * planar[0] / PLANE_FRAMES
    print(f"# kinefit: {ms:.4f} ms a frame, cost {plain[1]:.8g} m², {plain[2]:.2f} iterations")
    print(f"# kinefit, limits and robust loss: {ms_robust:.4f} ms, {robust[2]:.2f} iterations")
    print(f"# kinefit, {PLANES} planes: {ms_planes:.4f} ms, {planar[2]:.2f} iterations")
    figure("solver_markers", ms, "ms/frame", "<= 0.05")
    figure("solver_markers_limits_robust", ms_robust, "ms/frame", "<= 0.08")
    for peer, bound, mine, title in (
        ("momentum", 2.5, ms, "solver_vs_momentum"),
        ("mujoco", 5, ms, "solver_vs_mujoco"),
        ("mink", 5, ms, "solver_vs_mink"),
        ("pinocchio", 1, ms, "solver_vs_pinocchio"),
        ("opensim", 100, ms, "solver_vs_opensim"),
        ("momentum_planes", 15, ms_planes, "solver_planes_vs_momentum"),
    ):
        theirs = beside[peer].get("ms_per_frame_cpu")
        figure(title, theirs / mine if theirs else None, "x faster", f">= {bound}", beside[peer].get("reason", ""))
    costs = [p["cost"] for name, p in beside.items() if "cost" in p and name != "momentum_planes"]
    spread = max(abs(c / plain[1] - 1) for c in costs) if costs else None
    figure("solver_same_residual", spread, "relative", "<= 1e-05", "no peer ran")
    figure("solver_planes", ms_planes, "ms/frame", "<= 0.31")
    figure("solver_from_rest", 100.0 * from_rest(body, motions, rng), "% solved", "== 100")


def least(fit: Callable[[float], SequenceFit]) -> tuple[float, float, float]:
    """CPU seconds (least of several) at the loosest tolerance within EXCESS of the tightest cost; cost; iterations."""
    best = fit(1e-12).costs.sum()
    tolerance = next(t for t in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-12) if cost_of(fit, t) <= best * (1 + EXCESS))
    result, seconds = fastest(lambda: fit(tolerance), REPEATS)
    return seconds, float(result.costs.sum()), float(result.iterations.mean())


def cost_of(fit: Callable[[float], SequenceFit], tolerance: float) -> float:
    """Cost at the end, evaluated (a fit's own last figure is a prediction)."""
    result = fit(tolerance)
    return float(result.costs.sum())


def surface_planes(motion: Motion, rng: np.random.Generator) -> Planes:
    """Tangent planes at random points of the body's cylinders, taken as round, with noise along their normals."""
    body = motion.body
    owners, points, normals = [], [], []
    for _ in range(PLANES):
        c = body.surfaces[rng.integers(len(body.surfaces))]
        start, end, axis = np.array(c.start), np.array(c.end), c.axes[2]
        radial = np.cross(axis, rng.normal(size=3))
        radial /= np.linalg.norm(radial)
        tilted = radial + 0.5 * rng.normal(size=3)  # real limbs are not round: otherwise their turn would be free
        t = rng.uniform()
        owners.append(c.segment)
        radius = (1 - t) * c.mean_radii[0] + t * c.mean_radii[1]
        points.append((1 - t) * start + t * end + radius * radial)
        normals.append(tilted / np.linalg.norm(tilted))
    chosen = PointSet(tuple(f"p{i}" for i in range(PLANES)), np.array(owners), np.array(points))
    Ts = motion.segment_poses()[:PLANE_FRAMES, chosen.segments]
    n = (Ts[..., :3, :3] @ np.array(normals)[:, :, None])[..., 0]
    x = (Ts[..., :3, :3] @ chosen.points[:, :, None])[..., 0] + Ts[..., :3, 3]
    return Planes(chosen, x + rng.normal(0, NOISE, x.shape[:2])[..., None] * n, n, sigma=1.0)


def write(folder: Path, motion: Motion, markers: PointSet, x_world: NDArray, planes: Planes) -> None:
    """The same problem for the peers."""
    tree = motion.body.tree
    segments = [
        {
            "name": name,
            "parent": int(tree.parents[s]),
            "origin": tree.offsets[s].tolist(),
            "dofs": [
                {
                    "name": tree.coordinates[d],
                    "type": "prismatic" if tree.prismatic[d] else "revolute",
                    "axis": tree.axes[d].tolist(),
                }
                for d in range(tree.dof_start[s], tree.dof_start[s + 1])
            ],
        }
        for s, name in enumerate(tree.segments)
    ]
    points = [
        {"name": n, "segment": int(s), "point": p.tolist()}
        for n, s, p in zip(markers.names, markers.segments, markers.points, strict=True)
    ]
    write_problem(
        folder, segments, points, positions=x_world,
        initial_root=motion.Ts_world_root[0], initial_angles=motion.angles[0],
        truth_root=motion.Ts_world_root[:FRAMES], truth_angles=motion.angles[:FRAMES],
        plane_segment=planes.points.segments, plane_point_local=planes.points.points,
        plane_normal_world=planes.normal, plane_target_world=planes.x_world,
    )  # fmt: skip


def from_rest(body: Body, motions: dict[str, Motion], rng: np.random.Generator) -> float:
    """Share of 500 frames of all motions that are solved from the rest pose.

    All angles start at zero. The root is laid on all markers (Kabsch), as in every start with no pose given.
    """
    markers = body.markers("HANIM_45")
    solved = 0
    everything = [(m, f) for m in motions.values() for f in range(len(m))]
    for i in rng.choice(len(everything), FRAMES, replace=False):
        motion, frame = everything[i]
        x = body.positions(motion.state(frame), markers)

        def rows(state: BodyState, x: NDArray = x) -> Rows:
            return point_rows(body, state, markers, x, sigma=0.005)

        fit = levenberg_marquardt(body, body.rest_state(aligned_root(body, markers, x)), rows, max_iterations=100)
        solved += float(np.abs(body.positions(fit.state, markers) - x).max()) < 1e-3
    return solved / FRAMES
