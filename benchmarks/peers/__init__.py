"""The same inverse-kinematics problem, solved by peer libraries, each in its own virtual environment.

Peers are never dependencies of kinefit. `benchmarks.peers.environments` makes their environments and runs them; the
other modules here run *inside* a peer's environment (numpy, scipy and that peer, no kinefit).

Exchange format: a folder with two files. Lengths in metres, angles in radians.

``problem.json``
    ``segments``: list, parents before children, of ``name``; ``parent`` (index, -1 for the root, which comes first);
    ``origin`` [3], the segment's frame in its parent's frame in the rest pose, where all frames are parallel to the
    root's; ``dofs``, list of ``name``, ``type`` ("revolute" or "prismatic"), ``axis`` [3], a unit vector in the
    root-parallel rest frame; applied in order at that origin, so that R_parent_segment = R(axis0, q0) R(axis1, q1) ...
    The root moves freely in the world by six degrees of freedom that are not listed; it has no ``dofs``.
    ``markers``: list of ``name``, ``segment`` (index), ``point`` [3] in the segment's frame.

``problem.npz``
    ``positions`` (F, M, 3), marker targets in the world; ``initial_root`` (4, 4), T_world_root to start from;
    ``initial_angles`` (N,), all dofs in the order of the segments; ``truth_root`` (F, 4, 4), ``truth_angles`` (F, N).
    Optional second workload of P point-to-plane rows over G frames: ``plane_segment`` (P,), ``plane_point_local``
    (P, 3), ``plane_normal_world`` (G, P, 3), ``plane_target_world`` (G, P, 3), a point of each plane.

Every runner solves all frames in sequence, each from the solution of the one before. One measure holds for all: the
sum of squared residuals, in double precision, by the kinematics in this file. A runner is timed at the loosest setting
of its own stopping rule that brings that sum within 1e-6 (relative) of the least that it reaches at its tightest one.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

EXCESS = 1e-6  # relative excess over the least cost at which runners are timed


@dataclass(frozen=True)
class Problem:
    """One exchange folder, read. `planes` is None where the folder has no point-to-plane rows.

    `planes` holds segment (P,), point_local (P, 3), normal_world (G, P, 3), target_world (G, P, 3).
    """

    segments: list[dict[str, Any]]
    markers: list[dict[str, Any]]
    positions: np.ndarray
    initial_root: np.ndarray
    initial_angles: np.ndarray
    truth_root: np.ndarray
    truth_angles: np.ndarray
    planes: tuple[np.ndarray, ...] | None = None

    @property
    def marker_segments(self) -> np.ndarray:
        """Segment index of every marker, (M,)."""
        return np.array([marker["segment"] for marker in self.markers])

    @property
    def marker_points(self) -> np.ndarray:
        """Every marker in its segment's frame, (M, 3) [m]."""
        return np.array([marker["point"] for marker in self.markers], dtype=float)


def write_problem(
    folder: Path, segments: list[dict[str, Any]], markers: list[dict[str, Any]], **arrays: np.ndarray
) -> None:
    """Write an exchange folder; `arrays` as named in the module's text."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "problem.json").write_text(json.dumps({"segments": segments, "markers": markers}), encoding="utf-8")
    np.savez(folder / "problem.npz", **arrays)


def read_problem(folder: Path) -> Problem:
    """Read an exchange folder."""
    tree = json.loads((Path(folder) / "problem.json").read_text(encoding="utf-8"))
    keys = ("positions", "initial_root", "initial_angles", "truth_root", "truth_angles")
    plane_keys = ("plane_segment", "plane_point_local", "plane_normal_world", "plane_target_world")
    with np.load(Path(folder) / "problem.npz") as arrays:
        planes = tuple(arrays[key] for key in plane_keys) if plane_keys[0] in arrays else None
        return Problem(tree["segments"], tree["markers"], *(arrays[key] for key in keys), planes=planes)


def rotation_matrix(axis: Sequence[float], angle: Any) -> np.ndarray:
    """Rotation by `angle` (..., ) [rad] about the unit vector `axis` (3,): (..., 3, 3)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.asarray(angle, dtype=float)[..., None, None]
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def world_points(
    problem: Problem, root: np.ndarray, angles: np.ndarray, segments: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Points of segments in the world: root (F, 4, 4), angles (F, N), segments (P,), points (P, 3) -> (F, P, 3)."""
    rotations, origins, column = [], [], 0
    for segment in problem.segments:
        rotation, origin = root[:, :3, :3], root[:, :3, 3]
        if segment["parent"] >= 0:
            rotation = rotations[segment["parent"]]
            origin = origins[segment["parent"]] + rotation @ np.array(segment["origin"], dtype=float)
        for dof in segment["dofs"]:
            if dof["type"] == "revolute":
                rotation = rotation @ rotation_matrix(dof["axis"], angles[:, column])
            else:
                origin = origin + angles[:, column, None] * (rotation @ np.array(dof["axis"], dtype=float))
            column += 1
        rotations.append(rotation)
        origins.append(origin)
    rotations, origins = np.stack(rotations, axis=1), np.stack(origins, axis=1)
    return origins[:, segments] + np.einsum("fpij,pj->fpi", rotations[:, segments], points)


def marker_residuals(problem: Problem, root: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Marker minus target, (F, M, 3) [m]."""
    fitted = world_points(problem, root, angles, problem.marker_segments, problem.marker_points)
    return fitted - problem.positions[: len(root)]


def plane_residuals(problem: Problem, root: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distances of the points to their planes, (G, P) [m]."""
    assert problem.planes is not None
    segment, point_local, normal_world, target_world = problem.planes
    fitted = world_points(problem, root, angles, segment, point_local)
    return np.einsum("gpi,gpi->gp", normal_world, fitted - target_world)


def axes_frame(axes: Sequence[Sequence[float]]) -> tuple[np.ndarray, list[float]] | None:
    """Right-handed frame for a joint that turns about up to three orthogonal axes in a fixed order.

    Returns the frame, (3, 3) with columns `axes`, completed, and the sign (1 or -1) of every axis in it (only the
    third can be opposite); None where the axes are not orthogonal.
    """
    given = np.array(axes, dtype=float).reshape(-1, 3)
    if len(given) > 3 or not np.allclose(given @ given.T, np.eye(len(given)), atol=1e-9):
        return None
    first = given[0]
    second = given[1] if len(given) > 1 else np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    second = second / np.linalg.norm(second)
    third = np.cross(first, second)
    return np.column_stack([first, second, third]), [1.0, 1.0, float(np.sign(third @ given[-1]))][: len(given)]


def root_frame(root: np.ndarray, row: int, column: int) -> np.ndarray:
    """Frame (3, 3) in which the root's Euler angles stay farthest from their singularity.

    Of the three cyclic permutations of the axes, that for which entry (row, column) of the rotation, the sine of the
    middle angle, stays smallest over `root` (F, 4, 4).
    """
    frames = [np.roll(np.eye(3), shift, axis=1) for shift in range(3)]
    return min(frames, key=lambda frame: np.abs((frame.T @ root[:, :3, :3] @ frame)[:, row, column]).max())


def measure(
    peer: str,
    version: str,
    solve: Callable[[float], tuple[Any, int | None]],
    residuals: Callable[[Any], np.ndarray],
    settings: Sequence[float],
    truth: np.ndarray,
    notes: str = "",
    repeats: int = 15,
    default: float | None = None,
) -> dict[str, Any]:
    """Time `solve` at the first of `settings` that converges and print the result as one line of JSON.

    Parameters
    ----------
    solve
        `solve(setting) -> (solution, iterations of all frames)` runs the whole sequence; only this is timed.
    residuals
        `residuals(solution)`, (F, M, 3) or (G, P) [m], by the kinematics of this package.
    settings
        Stopping thresholds from loose to tight; the last gives the least cost to compare with.
    truth
        Residuals at the truth; a solver that ends above their sum of squares has not converged.
    default
        The peer's own default threshold where that does not converge; timed too, once, and told apart.

    Returns
    -------
    ``peer``, ``version``, ``ms_per_frame_cpu`` (process time) and ``ms_per_frame_wall``, each the least of `repeats`
    runs of the whole sequence; ``rms_m`` per marker or row; ``cost``, the sum of all squared residuals [m^2];
    ``iterations_mean`` per frame, None where unknown; ``notes``; with `default`, ``default_ms_per_frame_cpu`` and
    ``default_cost``.
    """
    least = np.sum(residuals(solve(settings[-1])[0]) ** 2)
    if not least <= np.sum(truth**2):
        raise SystemExit(f"did not converge: cost {least:g} m^2, at the truth {np.sum(truth**2):g}")
    chosen = settings[-1]
    for setting in settings[:-1]:
        if np.sum(residuals(solve(setting)[0]) ** 2) <= least * (1 + EXCESS):
            chosen = setting
            break
    cpu, wall, iterations, found = _time(solve, residuals, chosen, repeats)
    frames = len(found)
    result = {
        "peer": peer,
        "version": version,
        "ms_per_frame_cpu": 1e3 * cpu / frames,
        "ms_per_frame_wall": 1e3 * wall / frames,
        "rms_m": float(np.sqrt(np.sum(found**2) / np.prod(found.shape[:2]))),
        "cost": float(np.sum(found**2)),
        "iterations_mean": None if iterations is None else iterations / frames,
        "notes": f"stopping threshold {chosen:g}; {notes}",
    }
    if default is not None:
        cpu, _, _, found = _time(solve, residuals, default, 1)
        result |= {"default_ms_per_frame_cpu": 1e3 * cpu / frames, "default_cost": float(np.sum(found**2))}
    print(json.dumps(result), flush=True)
    return result


def _time(
    solve: Callable, residuals: Callable, setting: float, repeats: int
) -> tuple[float, float, int | None, np.ndarray]:
    """Least CPU and wall time [s] of `repeats` runs, iterations and residuals of the last."""
    cpu = wall = np.inf
    for _ in range(repeats):
        cpu_before, wall_before = time.process_time(), time.perf_counter()
        solution, iterations = solve(setting)
        cpu, wall = min(cpu, time.process_time() - cpu_before), min(wall, time.perf_counter() - wall_before)
    return cpu, wall, iterations, residuals(solution)


def read_mot(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of the columns and the table of a MOT or STO file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    head = lines.index("endheader")
    rows = [[float(v) for v in line.split()] for line in lines[head + 2 :] if line.strip()]
    return lines[head + 1].split(), np.array(rows)
