"""Closest points on tapered elliptical cylinders: time, error, growth with the number of points.

    python -m benchmarks depth depth_surfaces

Points lie about the ten parts of a standing person, 2 cm (standard deviation) off the surface, as a depth camera and a
pose that is slightly wrong give them; nothing is sought beyond 10 cm. One core; the least of many runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import figure
from benchmarks.timing import timed
from kinefit.bodies import load_body
from kinefit.bodies.surfaces.closest._kernels_cylinder import nearest_on_cylinders, nearest_on_cylinders_exact
from kinefit.bodies.surfaces.places import sample

COUNT, BOUND, NOISE = 5000, 0.1, 0.02  # points; [m]; [m]


def person() -> tuple[NDArray, NDArray, NDArray]:
    """Table (10, 18) of a person's parts, one cylinder each; frames (S, 12); 50,000 points (3, N) [m] about them."""
    body = load_body("humanoid10")
    parts = tuple(next(c for c in body.surfaces if c.segment == s) for s in range(len(body.tree.segments)))
    body = replace(body, surfaces=parts)
    state = body.default_state()
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    rest, _, segment = sample(body, 10 * COUNT)
    f = frames[segment]
    x = (f[:, :9].reshape(-1, 3, 3) @ rest[:, :, None])[..., 0] + f[:, 9:]
    random = np.random.default_rng(0)
    x = (x + random.normal(scale=NOISE, size=x.shape))[random.permutation(len(x))]
    return body.surface_tables.cylinders, frames, np.ascontiguousarray(x.T)


def search(
    kernel: Callable[..., None], table: NDArray, frames: NDArray, x: NDArray, repeats: int = 50
) -> tuple[float, NDArray]:
    """Least time [ms] of a search, and the distances (N,) [m] found."""
    n, spent = x.shape[1], list[float]()
    best, normal, segment, only = np.empty(n), np.zeros((3, n)), np.empty(n, np.int64), np.full(n, -1)
    for _ in range(repeats):
        best[:], segment[:] = BOUND, -1
        with timed(spent, 1e3, clock=time.perf_counter):
            kernel(x, frames, table, only, best, normal, segment)
    return min(spent), best


def in_chunks(kernel: Callable[..., None], table: NDArray, frames: NDArray, points: NDArray, size: int) -> float:
    """Time [ms] for all points, so many at a time: other ones each time, so that no branch is learnt by heart."""
    chunks = [np.ascontiguousarray(points[:, i : i + size]) for i in range(0, points.shape[1], size)]
    return min(sum(search(kernel, table, frames, x, 1)[0] for x in chunks) for _ in range(5))


def run() -> None:
    """Print the figures."""
    table, frames, points = person()
    x = np.ascontiguousarray(points[:, :COUNT])
    search(nearest_on_cylinders, table, frames, x, 2), search(nearest_on_cylinders_exact, table, frames, x, 2)
    fast, roughly = search(nearest_on_cylinders, table, frames, x)
    exact, exactly = search(nearest_on_cylinders_exact, table, frames, x)
    error = 1e3 * np.abs(np.abs(roughly) - np.abs(exactly))
    figure("closest_fast_ms", fast, "ms for 5,000 points x 10 cylinders", "<= 0.15")
    figure("closest_exact_ms", exact, "ms for 5,000 points x 10 cylinders", "<= 1.0")
    figure("closest_fast_error_mm", float(np.percentile(error, 99)), "mm (99 of 100 points)", "<= 0.1")
    counts = np.array([1000, 2000, 5000, 10000, 20000, 50000])
    for name, kernel in (("fast", nearest_on_cylinders), ("exact", nearest_on_cylinders_exact)):
        times = np.array([in_chunks(kernel, table, frames, points, n) for n in counts])  # [ms] for all points
        power = float(np.polyfit(np.log(counts), np.log(times * counts), 1)[0])
        figure(f"closest_{name}_growth", power, "power of the number of points, 1k to 50k", "<= 1.1")
