"""The paper's synthetic test (P5 4.1) for SAPM as printed and for `identify`.

Neither is told distortion, missing or extra. POSES poses a cell (200), CLEAN noise-free poses (2000). With a file's
name (`... surface.svg`) it draws the surface of P5 Fig. 3 for both.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.papers.markers.synthetic_points import random_pose, synthetic_body
from benchmarks.scenes.marker_takes import counts
from benchmarks.timing import timed
from kinefit.markers.frame.identify import identify
from kinefit.markers.model.model import MarkerModel
from kinefit.papers.sapm import sapm

POSES = int(os.environ.get("POSES", amount(200, 1)))
CLEAN = int(os.environ.get("CLEAN", amount(2000, 5)))
Identifier = Callable[[MarkerModel, NDArray], NDArray]


@dataclass(frozen=True)
class Score:
    """Shares of frames entirely right; of seen labels right; of all labels wrong, not unknown; ms a frame."""

    whole: float
    right: float
    wrong: float
    median: float
    slowest: float


def ours(model: MarkerModel, points: NDArray) -> NDArray:
    """`identify` with its defaults."""
    return identify(model, points).assignment


def score(method: Identifier, model: MarkerModel, poses: int, seed: int = 1, **kind: float) -> Score:
    """A method over random poses of one kind."""
    rng = np.random.default_rng(seed)
    whole, counted, times = 0, np.zeros(3, int), []
    for _ in range(poses):
        pose = random_pose(model, rng, **kind)
        with timed(times, 1e3):
            found = method(model, pose.points)
        whole += bool((found == pose.truth).all())
        counted += counts(found, pose.truth)
    right, wrong, seen = counted.tolist()
    return Score(whole / poses, right / seen, wrong / (poses * len(model)), float(np.median(times)), max(times))


def table(model: MarkerModel) -> None:
    """Distortion, share missing and number extra: those with a goal, none of all, and much of the first two."""
    print("distortion missing extra | identify: right wrong median ms slowest | SAPM: right wrong median ms")
    worst, medians, slowest = 0.0, [], []
    goals = {(0.04, 0.0, 0): 99.95, (0.06, 0.0, 0): 99.7, (0.1, 0.0, 0): 98.3, (0.0, 0.1, 0): 99.6,
             (0.04, 0.1, 0): 99.6,
             (0.0, 0.2, 0): 99.0, (0.04, 0.2, 0): 97.5, (0.04, 0.0, 20): 99.9}  # fmt: skip
    results = {}
    for kind in [(0.0, 0.0, 0), *goals, *amount([(0.1, 0.2, 0)], [])]:
        named = dict(zip(("distortion", "missing", "extra"), kind))
        a = score(ours, model, POSES, **named)
        b = score(sapm, model, POSES, **named)
        print(
            f"{kind[0]:10.0%} {kind[1]:7.0%} {kind[2]:5d} | {a.right:8.2%} {a.wrong:7.3%} "
            f"{a.median:7.1f} {a.slowest:7.0f} "
            f"| {b.right:7.1%} {b.wrong:6.1%} {b.median:7.1f}", flush=True,
        )  # fmt: skip
        worst, results[kind] = max(worst, a.wrong), a.right
        medians.append(a.median)
        slowest.append(a.slowest)
    for kind, goal in goals.items():
        name = f"markers_synthetic_right_{100 * kind[0]:.0f}_missing{100 * kind[1]:.0f}_extra{kind[2]}"
        figure(name, 100 * results[kind], "%", f">= {goal}")
    figure("markers_synthetic_wrong_worst", 100 * worst, "%", "<= 0.1")
    figure("markers_synthetic_slowest", max(slowest), "ms", "<= 1000")
    figure("markers_synthetic_median_worst", max(medians), "ms", "<= 100")


def surface(model: MarkerModel, file: Path) -> None:
    """Draw labels right over distortion and rotation (P5 Fig. 3)."""
    distortions, rotations = np.arange(0, 11, 2) / 100, np.arange(0, 5)
    poses = max(POSES // 10, 5)
    found = {
        name: [
            [score(method, model, poses, distortion=float(d), rotation=float(r)).right for d in distortions]
            for r in rotations
        ]
        for name, method in (("identify", ours), ("SAPM", sapm))
    }
    file.write_text(drawing(found, distortions, rotations), "utf-8")


def drawing(found: dict[str, list[list[float]]], distortions: NDArray, rotations: NDArray) -> str:
    """SVG: one chart a method, labels right over distortion, a line a range of rotation."""
    colours = ("#08306b", "#2171b5", "#4fa3cf", "#f0803c", "#b3261e")
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 920 400" font-family="sans-serif" font-size="13">',
             '<rect width="920" height="400" fill="white"/>']  # fmt: skip
    for n, (name, rows) in enumerate(found.items()):
        left, top, width, height = 60 + 440 * n, 50, 350, 270
        parts.append(f'<text x="{left}" y="30" font-size="16" font-weight="bold">{name}: labels right</text>')
        for k in range(6):
            y = top + height * (1 - k / 5)
            parts.append(f'<path d="M{left} {y}h{width}" stroke="#ddd"/>')
            parts.append(f'<text x="{left - 8}" y="{y + 4}" text-anchor="end">{20 * k} %</text>')
        for d in distortions:
            x = left + width * d / distortions[-1]
            parts.append(f'<text x="{x}" y="{top + height + 20}" text-anchor="middle">{d:.0%}</text>')
        middle, under = left + width / 2, "distortion, share of a segment's mean distance"
        parts.append(f'<text x="{middle}" y="{top + height + 42}" text-anchor="middle">{under}</text>')
        for r, row, colour in zip(rotations, rows, colours):
            line = " ".join(
                f"{left + width * d / distortions[-1]:.1f},{top + height * (1 - v):.1f}"
                for d, v in zip(distortions, row)
            )
            parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>')
            if n == 0:
                x = 60 + 130 * int(r)
                parts.append(f'<path d="M{x} 388h24" stroke="{colour}" stroke-width="3"/>')
                parts.append(f'<text x="{x + 30}" y="392">0–{r} rad</text>')
    return "\n".join([*parts, "</svg>\n"])


def run(file: Path | None = None) -> None:
    """All figures."""
    model = synthetic_body(44)
    score(ours, model, 3)
    clean = score(ours, model, CLEAN)
    figure("markers_synthetic_clean_identify", 100 * clean.whole, "% of frames", ">= 99.9")
    figure("markers_synthetic_clean_identify_median", clean.median, "ms", "<= 3")
    large = score(ours, synthetic_body(49), max(CLEAN // 10, 10))
    figure("markers_synthetic_clean_identify_49", 100 * large.whole, "% of frames", ">= 99.9")
    figure("markers_synthetic_clean_sapm", 100 * score(sapm, model, CLEAN).whole, "% of frames", ">= 95")
    firm = score(partial(sapm, epsilon=0.02, beta=0.5), model, POSES, missing=0.2)  # rigid subjects: small ε, low β
    loose = score(sapm, model, POSES, missing=0.2)
    print(f"# SAPM, rigid, 20 % missing: {firm.right:.1%} right at ε 0.02, β 0.5; {loose.right:.1%} at ε 0.1, β 0.8")
    figure("markers_synthetic_sapm_rigid", 100 * firm.right, "% right", f">= {100 * loose.right:.1f}")
    table(model)
    if file is not None:
        surface(model, file)


if __name__ == "__main__":
    run(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
