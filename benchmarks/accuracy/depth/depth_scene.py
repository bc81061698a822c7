"""The rendered ten-part body of `scene_body10` from depth alone, on the frames that M3T was given (see its README).

`KINEFIT_SCENE` names the folder with `body10/` and `body10occl/`. ADD is the mean distance of a part's vertices from
their true place; a part is lost above 100 mm and found below 50 mm. As with M3T, tracking starts at the truth.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import FAILED, NotMeasured, amount, figure
from benchmarks.papers.regions.scene_body10 import (
    FOUND,
    LOST,
    RATE,
    Run,
    Scene,
    disturbed,
    folder,
    load_scene,
    run_scene,
)
from benchmarks.peers.environments import measured

STARTS, SEEDS, PASSES = range(10, 300, amount(29, 145)), range(amount(3, 1)), 3
NEVER = 999.0  # [s] for a part that is not found again
_GOALS = (
    ("scene_cpu_min_ms", "ms/frame", "<= 5"),
    ("scene_cpu_ms", "ms/frame", "<= 5"),
    ("scene_add_mm", "mm", "<= 8"),
    ("scene_lost", "%", "== 0"),
    ("scene_every2_mm", "mm", "<= 12"),
    ("scene_occluded_lost", "%", "<= 3"),
    ("scene_occluded_found_s", "s", "<= 1"),
    ("scene_start20", "of parts", ">= 0.75"),
    ("scene_start30", "of parts", ">= 0.55"),
    ("lost_recall", "of lost parts", ">= 0.95"),
    ("lost_false", "%", "<= 2"),
    ("startup_s", "s", "<= 3"),
    ("startup_gb", "GB", "<= 1"),
)


def tracker(body: Any, rig: Any, rate: float) -> Any:
    """What is measured: the tracker as it comes."""
    from kinefit.fitting.tracking.tracker import Tracker

    return Tracker(body, rig, rate=rate, up="y")


def run() -> None:
    """Print every figure of the scene."""
    plain, occluded = folder("body10"), folder("body10occl")
    if plain is None or occluded is None:
        raise NotMeasured("KINEFIT_SCENE names no folder with body10/ and body10occl/")
    measured = _speed() | _accuracy(load_scene(plain), load_scene(occluded))
    for name, unit, goal in _GOALS:
        figure(name, measured.get(name), unit, goal, "its process failed")


def _accuracy(plain: Scene, occluded: Scene) -> dict[str, float]:
    runs = {every: run_scene(plain, tracker, every=every) for every in (1, 2, 3, 4)}
    hidden = run_scene(occluded, tracker)
    for name, r in [*((f"every {n}", r) for n, r in runs.items()), ("occluder", hidden)]:
        print(f"# {name}: ADD mean {r.add.mean():.1f}, p95 {np.percentile(r.add, 95):.1f} mm, "
              f"lost {100 * r.lost_share:.1f} %")  # fmt: skip
    judged = [_flags(plain, runs[3]), _flags(plain, runs[4]), _flags(occluded, hidden)]
    lost, good = (np.concatenate([j[k] for j in judged]) for k in (0, 1))
    print(f"# {len(lost)} lost part-frames, {len(good)} good ones that are seen")
    return {
        "scene_add_mm": float(runs[1].add.mean()),
        "scene_lost": 100.0 * runs[1].lost_share,
        "scene_every2_mm": float(runs[2].add.mean()),
        "scene_occluded_lost": 100.0 * hidden.lost_share,
        "scene_occluded_found_s": longest_search(hidden.add, unhidden(occluded, hidden)),
        "scene_start20": started(plain, 20.0),
        "scene_start30": started(plain, 30.0),
        "lost_recall": float(lost.mean()) if len(lost) else np.nan,
        "lost_false": 100.0 * float(good.mean()),
    }


def unhidden(scene: Scene, r: Run) -> NDArray:
    """(F, 10) share of each part's true outline that neither another part nor an obstacle hides."""
    from kinefit.sensors.visibility.visibility import Layers

    layers = Layers(scene.body, scene.rig["depth"], mesh=scene.mesh)
    out = np.empty(r.add.shape)
    for row, i in zip(out, r.frames):
        layers.draw(scene.true_vertices(i))
        drawn = np.isfinite(layers.front)
        ratio = scene.rig["depth"].size[0] // layers.camera.size[0]
        measured = scene.depth(i).depth[ratio // 2 :: ratio, ratio // 2 :: ratio]
        free = drawn & ((measured == 0.0) | (measured > layers.front - 0.1))  # the board is a metre in front
        row[:] = np.bincount(layers.owner[free], minlength=len(row)) / np.maximum(layers.counts[:, 0], 1)
    return out


def _flags(scene: Scene, r: Run) -> tuple[NDArray, NDArray]:
    """Flags ("lost" or "not seen") of the parts that are lost, and of good ones of which half or more can be seen."""
    good = (r.add <= FOUND) & (unhidden(scene, r) >= 0.5)
    return r.flagged[r.add > LOST], r.flagged[good]


def longest_search(add: NDArray, shown: NDArray) -> float:
    """Longest time [s] from a lost part's coming into view (half of its outline) until it is found again."""
    longest = 0.0
    for away, seen in zip(add.T, shown.T):
        k = 0
        while k < len(away):
            if away[k] <= LOST or seen[k] < 0.5:
                k += 1
                continue
            found = np.flatnonzero(away[k:] <= FOUND)
            if not len(found):
                return NEVER
            longest = max(longest, float(found[0]) / RATE)
            k += int(found[0])
    return longest


def started(
    scene: Scene, degrees: float, tracker: Callable[[Any, Any, float], Any] = tracker, kinds: Sequence[str] = ("depth",)
) -> float:
    """Share of parts within 50 mm after three passes over one frame, all joints off by so many degrees at first."""
    within = []
    for i in STARTS:
        frames_at = scene.seen(i, kinds)
        for seed in SEEDS:
            made = tracker(scene.body, scene.rig, RATE)
            made.start_at(disturbed(scene, i, degrees, np.random.default_rng(1000 * seed + i)))
            for step in range(PASSES):
                result = made.update(frames_at((i + step) / RATE))
            within.append(scene.add(result.state, i) <= FOUND)
    return float(np.mean(within))


def _speed() -> dict[str, float]:
    """CPU time a frame on one thread, and what a process needs to its first state; in processes of their own."""
    out: dict[str, float] = {}
    for what in ("startup", "cpu", "startup"):  # the first fills the cache of compiled kernels
        begin = time.monotonic()
        command = [sys.executable, "-m", "benchmarks.accuracy.depth.depth_scene", what]
        found, reason, _ = measured(command, os.environ, 600.0)
        if reason:
            FAILED.append(f"depth_scene {what}")
            print(f"# {what}: {reason}")
            continue
        out |= found
        if what == "startup":
            out["startup_s"] = time.monotonic() - begin
    return out


def _part(what: str) -> dict[str, float]:
    path = folder("body10")
    assert path is not None
    scene = load_scene(path)
    if what == "cpu":
        ms = run_scene(scene, tracker).ms[5:]
        return {"scene_cpu_min_ms": float(ms.min()), "scene_cpu_ms": float(np.median(ms))}
    made = tracker(scene.body, scene.rig, RATE)
    made.start_at(scene.states[0])
    made.update([scene.depth(0)])
    return {"startup_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(_part(sys.argv[1])))
    else:
        run()
