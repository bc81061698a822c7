"""Meshes as surfaces: how exact their distance grids are, and what they cost."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tests.bodies.surfaces.shapes import brute_force, points_on

from benchmarks.figures import figure, recording
from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.surfaces.closest._kernels_grid import nearest_on_grids
from kinefit.bodies.surfaces.closest.grid import distance_grid, parts
from kinefit.bodies.surfaces.mesh import GridTable, mesh_surface, pack_grids

NEAR = (-0.02, 0.05)  # [m] from the surface, where measured points lie
GOALS = {
    "distance_mean_mm": "<= 0.2",
    "distance_p95_mm": "<= 0.5",
    "distance_max_mm": "<= 3",
    "normal_median_deg": "<= 4",
    "wrong_signs": "== 0",
    "build_s": "<= 0.3",
    "nearest_5000x10_ms": "<= 0.5",
}


def run() -> None:
    """Print the figures on the ten-part body's meshes."""
    folder = recording("scene_body10")
    meshes = {path.stem: mesh_surface(path, 0) for path in sorted((folder / "meshes").glob("*.obj"))}
    values = _errors(list(meshes.values())) | {"build_s": max(_build_time(m) for m in meshes.values())}
    values["nearest_5000x10_ms"] = 1e3 * _search_time(folder, meshes)
    for name, goal in GOALS.items():
        figure(f"grid_{name}", values[name], name.rpartition("_")[2], goal)


def _errors(meshes: list[MeshSurface]) -> dict[str, float]:
    """Against a search over all triangles; inside of meshes of two parts there is nothing to compare with."""
    rng, distances, angles, wrong = np.random.default_rng(0), [], [], 0
    still = np.array([[1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]])
    for mesh in meshes:
        p, n = points_on(mesh.vertices, mesh.faces, 400, rng)
        x = p + n * rng.uniform(*NEAR, (len(p), 1))
        expected, closest = brute_force(x, mesh.vertices, mesh.faces)
        best, normal = _search(pack_grids([mesh], np.zeros((1, 3))), x, still, 1.0)
        keep = expected > 1e-3 if len(parts(mesh.faces)) > 1 else abs(expected) > 1e-3
        truth = (x - closest) / expected[:, None]
        distances.append(1e3 * np.abs(best - expected)[keep])
        angles.append(np.degrees(np.arccos(np.clip(np.sum(truth * normal, axis=1), -1.0, 1.0)))[keep])
        wrong += int(np.sum((best * expected < 0)[keep]))
    d, a = np.concatenate(distances), np.concatenate(angles)
    return {
        "distance_mean_mm": float(d.mean()), "distance_p95_mm": float(np.quantile(d, 0.95)),
        "distance_max_mm": float(d.max()), "normal_median_deg": float(np.median(a)), "wrong_signs": float(wrong),
    }


def _build_time(mesh: MeshSurface) -> float:
    assert mesh.grid.cell > 0  # compiled
    start = time.process_time()
    distance_grid(mesh.vertices, mesh.faces)
    return time.process_time() - start


def _search(table: GridTable, x: NDArray, frames: NDArray, bound: float) -> tuple[NDArray, NDArray]:
    count = len(x)
    best, normal, segment = np.full(count, bound), np.zeros((3, count)), np.full(count, -1)
    nearest_on_grids(np.ascontiguousarray(x.T), frames, *table, np.full(count, -1), best, normal, segment)
    return best, normal.T


def _search_time(folder: Path, meshes: dict[str, MeshSurface]) -> float:
    """[s] for 5,000 points on the side of the body that faces the camera, 1 cm of noise, within 10 cm; best of 50."""
    lines = [line.split() for line in (folder / "scene.txt").read_text().splitlines()[1:]]
    Ts_camera_part = np.loadtxt(folder / "gt.txt").reshape(-1, len(lines), 3, 4)[40]
    rng, frames, points = np.random.default_rng(1), np.zeros((len(lines), 12)), []
    for s, (line, T) in enumerate(zip(lines, Ts_camera_part)):
        R, t = T[:, :3], T[:, 3] - T[:, :3] @ np.array(line[5:8], float)
        frames[s] = [*R.ravel(), *t]
        p, n = points_on(meshes[line[1]].vertices, meshes[line[1]].faces, 1500, rng)
        seen = np.sum((n @ R.T) * (p @ R.T + t), axis=1) < 0
        points.append((p + n * rng.normal(0.0, 0.01, (len(p), 1)))[seen] @ R.T + t)
    x = rng.permutation(np.concatenate(points))[:5000]
    table = pack_grids([replace(meshes[line[1]], segment=s) for s, line in enumerate(lines)], np.zeros((len(lines), 3)))
    x_soa, any_segment, times = np.ascontiguousarray(x.T), np.full(len(x), -1), []
    for _ in range(50):
        best, normal, segment = np.full(len(x), 0.1), np.zeros((3, len(x))), np.full(len(x), -1)
        start = time.perf_counter()
        nearest_on_grids(x_soa, frames, *table, any_segment, best, normal, segment)
        times.append(time.perf_counter() - start)
    return min(times)
