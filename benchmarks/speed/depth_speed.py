"""Time of the fusion tracker: a frame of 5,000 points, growth with points, cost of background; Open3D beside it.

    python -m benchmarks depth depth_speed

CPU time of one core and one thread, in processes of their own. A person of ten parts moves before a simulated sensor of
the Kinect's kind; tracking starts at the truth, searching is off. The time of a frame is the least of several passes.
`KINEFIT_OPEN3D_PYTHON` names a Python with open3d: it is given the same clouds, see `benchmarks.peers.open3d_icp`.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import FAILED, LEFT_OUT, amount, figure, peers, quick
from benchmarks.peers.environments import measured, on_one_core
from benchmarks.timing import timed

MOVEMENTS = amount(("walk", "clap", "sit_down", "kick"), ("clap",))  # all of the body, its arms, all its bends, one leg
POINTS, COUNTS = 5000, (1000, 2000, 5000, 10000, 20000, 50000)
PASSES, WARM = amount(5, 1), 5  # passes; frames at the beginning that are not timed
FEW = amount(30, 10)  # frames for the growth and the background
_GOALS = (
    ("fusion_5000_ms", "ms/frame", "<= 4"),
    ("points_slope", "power of the number of points, 5k to 50k", "<= 1.1"),
    ("background_cost", "%", "<= 10"),
    ("open3d_times_faster", "x", ">= 5"),
    ("open3d_times_smaller_error", "x", ">= 3"),
)
_PART_OF = {"fusion_5000_ms": "fusion", "points_slope": "slope", "background_cost": "background"}


def run() -> None:
    """Print the figures."""
    values: dict[str, float] = {}
    reasons: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for part in ("fusion", "slope", "background"):
            found, reasons[part] = _process([sys.executable, "-m", "benchmarks.speed.depth_speed", part, folder])
            values |= found
            FAILED.extend([f"depth_speed {part}"] * bool(reasons[part]))
        python = os.environ.get("KINEFIT_OPEN3D_PYTHON")
        if not peers():
            reasons["open3d"] = LEFT_OUT if quick() else "--no-peers"
        elif not python:
            reasons["open3d"] = "KINEFIT_OPEN3D_PYTHON names no Python with open3d"
        elif reasons["fusion"]:
            reasons["open3d"] = reasons["fusion"]
        else:
            found, reasons["open3d"] = _process([python, "-m", "benchmarks.peers.open3d_icp", folder])
            values |= found
    if "open3d_ms" in values:
        ms, mm = values["fusion_median_ms"], values["fusion_mm"]
        values["open3d_times_faster"] = values["open3d_ms"] / ms
        values["open3d_times_smaller_error"] = values["open3d_mm"] / mm
        print(f"# open3d {values['version']}: {values['open3d_ms']:.2f} ms/frame, joints {values['open3d_mm']:.1f} mm; "
              f"fusion: {ms:.2f} ms/frame, {mm:.1f} mm (medians of the first pass, means of all joints)")  # fmt: skip
    for name, unit, goal in _GOALS:
        figure(name, values.get(name), unit, goal, reasons[_PART_OF.get(name, "open3d")])


def _process(command: list[str]) -> tuple[dict[str, Any], str]:
    """What a process measured on one core, and why it did not; its other lines are printed."""
    found, reason, lines = measured(on_one_core(command), os.environ, 1800.0)
    print(*lines, sep="\n", flush=True)
    return {} if reason else found, reason


class Stage:
    """A movement before a sensor."""

    def __init__(self, movement: str, *, finer: int = 1) -> None:
        from kinefit.geometry.camera import Rig
        from kinefit.simulation.figures import in_front
        from kinefit.simulation.movements import movement as moving
        from kinefit.simulation.rendering.sensors import KINECT

        w, h = KINECT.size
        self.motion = moving(movement)
        self.sensor = replace(KINECT, size=(finer * w, finer * h), focal=finer * KINECT.focal, far=8.0)  # [m] walls too
        self.camera = in_front(self.motion, self.sensor.camera(), near=self.sensor.near, far=self.sensor.far)
        self.rig = Rig((self.camera,))
        away = np.linalg.norm(self.camera.centre_world - self.motion.Ts_world_root[:, :3, 3].mean(axis=0))
        self.accuracy = float(self.sensor.sigma(float(away)))  # [m]

    def depth(self, frame: int, *, room: bool = False) -> NDArray:
        """(H, W) [m] an image of it."""
        from kinefit.simulation.rendering.sensors import simulate_depth

        return simulate_depth(self.motion, self.camera, self.sensor, room=room).frame(frame).depth

    def points(self, frame: int) -> NDArray:
        """(N, 3) [m] all points of the body in an image, in a random order."""
        from kinefit.images.depth import to_points

        return np.random.default_rng(frame).permutation(to_points(self.depth(frame), self.camera))

    def cloud(self, frame: int, points: NDArray) -> Any:
        """What the tracker is given of a frame."""
        from kinefit.observations import PointCloud

        time = float(self.motion.times[frame])
        return PointCloud(self.camera.name, time, points, self.camera.centre_world, on_body=True)

    def follow(self, frames: Sequence[Any], points: int = POINTS) -> tuple[NDArray, list[Any]]:
        """CPU time [ms] and result of each frame, from the second frame of the movement on."""
        from kinefit.fitting.tracking.tracker import Tracker
        from kinefit.sensors.settings import TrackSettings

        settings = TrackSettings(points=points, search=False)
        tracker = Tracker(
            self.motion.body, self.rig, rate=self.motion.rate, settings=settings,
            sigma={self.camera.name: self.accuracy},
        )  # fmt: skip
        tracker.start_at(self.motion.state(0))
        ms, results = [], []
        for frame in frames:
            with timed(ms, 1e3):
                results.append(tracker.update([frame]))
        return np.array(ms), results

    def error(self, results: list[Any]) -> NDArray:
        """(F, S) [mm] distance of the joints from their true places, from the second frame of the movement on."""
        tree, truth = self.motion.body.tree, self.motion.segment_poses()[1:, :, :3, 3]
        found = [tree.segment_poses(r.state.T_world_root[None], r.state.angles[None])[0, :, :3, 3] for r in results]
        return 1e3 * np.linalg.norm(np.array(found) - truth[: len(found)], axis=-1)


def _fusion(folder: Path) -> dict[str, float]:
    """Time and error with 5,000 points of the body a frame; the clouds are left in the folder."""
    from kinefit.bodies.surfaces.places import sample

    least, first, iterations, error = [], [], [], []
    told: dict[str, Any] = {}
    for name in MOVEMENTS:
        stage = Stage(name)
        points = np.array([stage.points(i)[:POINTS] for i in range(len(stage.motion))])
        told |= {f"{name}_points": points, f"{name}_truth": stage.motion.segment_poses()}
        frames = [stage.cloud(i, x) for i, x in enumerate(points[1:], start=1)]
        passes = [stage.follow(frames) for _ in range(PASSES)]
        error.append(stage.error(passes[0][1]))
        iterations += [r.iterations for r in passes[0][1]]
        least.append(np.min([ms for ms, _ in passes], axis=0)[WARM:])
        first.append(passes[0][0][WARM:])
        print(f"# {name}: {np.median(least[-1]):.2f} ms, joints mean {error[-1].mean():.1f} mm")
    body = stage.motion.body
    x, normals, owners = sample(body, POINTS)
    told |= {"names": MOVEMENTS, "samples": x - body.tree.rest[owners], "normals": normals, "owners": owners}
    np.savez(folder / "clouds.npz", **told)
    ms, once = np.concatenate(least), np.concatenate(first)
    median, mm = float(np.median(once)), float(np.concatenate(error).mean())
    print(f"# {POINTS} points, {len(ms)} frames, least of {PASSES} passes: min {ms.min():.2f}, median "
          f"{np.median(ms):.2f}, 95 of 100 below {np.percentile(ms, 95):.2f} ms; first pass: median {median:.2f} ms; "
          f"{np.mean(iterations):.1f} iterations")  # fmt: skip
    return {"fusion_5000_ms": float(np.median(ms)), "fusion_median_ms": median, "fusion_mm": mm}


def _slope(_: Path) -> dict[str, float]:
    """Growth of the time with the number of points."""
    stage = Stage("clap", finer=2)
    points = [stage.points(i) for i in range(1, FEW)]
    fewest = min(map(len, points))
    if fewest < COUNTS[-1]:
        raise ValueError(f"an image shows only {fewest} points of the body")
    clouds = {n: [stage.cloud(i, x[:n]) for i, x in enumerate(points, start=1)] for n in COUNTS}
    spent: dict[int, list[NDArray]] = {n: [] for n in COUNTS}
    for _pass in range(PASSES):  # in turns: what else the machine does slows all of them
        for n in COUNTS:
            ms, results = stage.follow(clouds[n], n)
            spent[n].append(ms[WARM:])
            if not _pass:
                print(f"# {n} points: {np.mean([r.iterations for r in results]):.1f} iterations, "
                      f"joints mean {stage.error(results).mean():.1f} mm")  # fmt: skip
    times = {n: float(np.min(ms, axis=0).mean()) for n, ms in spent.items()}
    print("# points: " + ", ".join(f"{n // 1000}k {t:.2f} ms" for n, t in times.items()))
    return {"points_slope": float(np.log(times[50000] / times[5000]) / np.log(10.0))}


def _surrounded(body: NDArray, room: NDArray) -> NDArray:
    """The body's pixels (H, W) [m] and those of a room that are nearest to them in the image, nine times as many."""
    import cv2

    away = cv2.distanceTransform((body == 0.0).astype(np.uint8), cv2.DIST_L2, 5)
    away[(body > 0.0) | (room == 0.0)] = np.inf
    count = min(9 * int((body > 0.0).sum()), int(np.isfinite(away).sum()))
    out, nearest = np.array(body), np.argsort(away, axis=None, kind="stable")[:count]
    out.flat[nearest] = room.flat[nearest]
    return out


def _background(_: Path) -> dict[str, float]:
    """What background costs in a depth image: the same pixels of the body, alone and among nine times as many."""
    from kinefit.observations import DepthFrame

    stage = Stage("walk")
    images: dict[str, list[Any]] = {"alone": [], "in a room": []}
    shares = []
    for i in range(1, FEW):
        body, room = stage.depth(i), stage.depth(i, room=True)
        both = _surrounded(body, room)
        shares.append(1.0 - (body > 0.0).sum() / (both > 0.0).sum())
        for kind, image in zip(images, (body, both)):
            images[kind].append(DepthFrame(stage.camera.name, float(stage.motion.times[i]), image))
    spent: dict[str, list[NDArray]] = {kind: [] for kind in images}
    for _pass in range(PASSES):
        for kind, frames in images.items():
            ms, results = stage.follow(frames)
            spent[kind].append(ms[WARM:])
            if not _pass:
                print(f"# {kind}: {np.mean([r.iterations for r in results]):.1f} iterations, "
                      f"joints mean {stage.error(results).mean():.1f} mm")  # fmt: skip
    alone, among = (float(np.min(ms, axis=0).mean()) for ms in spent.values())
    print(f"# body alone {alone:.2f} ms, with {100 * np.mean(shares):.0f} % of the points background {among:.2f} ms")
    return {"background_cost": 100.0 * (among / alone - 1.0)}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        part = {"fusion": _fusion, "slope": _slope, "background": _background}[sys.argv[1]]
        print(json.dumps(part(Path(sys.argv[2]))))
    else:
        run()
