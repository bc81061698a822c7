"""The way of a measurement from a reader's record to a `Motion`: functions (hops) and types, counted while takes run.

A short take of keypoints, depth images, markers or an insole (`docs/own-sensor.md`) is tracked on a known body and
smoothed, while `sys.setprofile` looks at every object that is made. It is on the road if an attribute holds three of
the measured numbers or an object of the road, in tuples and dictionaries, too. Measured numbers are noisy, so no other
array has them by chance. The depth camera is the frame of the world, so its points keep their depth.

* types: classes of these objects, made once a frame or once a take, the frame of the record among them.
* hops: functions of kinefit that make them, unless as a copy (`dataclasses.replace`); a constructor belongs to its
  caller.

`Scene` is left out: it shows every sensor what the others measured. What rows become (normal equations, poses) holds
no measured numbers. By hand 17 hops and 12 types were counted for a keypoint, 10 and 9 for a depth image, 10 and 8 for
a marker, 5 and 4 for an own sensor: without records of whole takes, and without searches in depth images.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import figure
from kinefit import Measurement, Recording, RowsOf, Sensor, track
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame
from kinefit.sensors import Scene
from kinefit.simulation import DepthSensor, in_front, simulate_depth, simulate_keypoints, squat_and_wave, studio_rig

GOALS = {"keypoint": (9, 7), "depth": (8, 7), "marker": (7, 6), "own": (5, 4)}
_RATE = 10.0  # [Hz]
_MIN_SHARED = 3  # numbers that an array on the road has of the record
_MAX_LOOKED_UP = 3000  # numbers of an array, spread over it
_CAMERA = DepthSensor("depth", (96, 72), 82.0, 0.5, 5.5, (0.004, 0.0008, 0.0), holes=0.01)
_CELLS = ("r_calcaneus_posterior", "r_metatarsal_phalanx_5", "r_metatarsal_phalanx_1")


class Insole(Sensor):
    """A sensor of one's own."""

    name = "insole"

    def prepare(self, frame: Pressure, scene: Scene) -> Pressure:
        """The frame itself."""
        return frame


@dataclass
class Pressure(Measurement):
    """Load (3,) [N] of its cells at one time [s]."""

    time: float
    load: NDArray
    sensor: str = "insole"

    def match(self, scene: Scene, reach: float) -> RowsOf:
        """All cells are on the floor."""
        return RowsOf(self.rows, {"points": scene.body.landmarks.select(_CELLS)}, channels=_CELLS)

    def rows(self, scene: Scene, points: Any) -> Any:
        """A row for each cell, along the vertical."""
        return scene.along(points, (0.0, 1.0, 0.0), -scene.positions(points)[:, 1], 0.05)


class Road:
    """Hops and types of what holds some numbers (N,), of all that runs within the context."""

    def __init__(self, numbers: NDArray) -> None:
        self.numbers, self.hops, self.types = np.unique(numbers), set[str](), set[str]()
        self._held = dict[int, Any]()  # by id; kept, so that no other object gets the id

    def __enter__(self) -> Road:
        threading.setprofile(self._look)
        sys.setprofile(self._look)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]

    def _look(self, frame: FrameType | None, event: str, value: Any) -> None:
        if event != "return" or frame is None or frame.f_code.co_name != "__init__" or "self" not in frame.f_locals:
            return
        made = frame.f_locals["self"]
        if isinstance(made, Scene) or not type(made).__module__.startswith(("kinefit", __name__)):
            return
        if id(made) in self._held or not any(map(self._holds, vars(made).values())):
            return
        self._held[id(made)] = made
        self.types.add(type(made).__name__)
        while (frame := frame.f_back) is not None and frame.f_code is not replace.__code__:
            module, name = frame.f_globals.get("__name__", ""), frame.f_code.co_name
            if module.startswith("kinefit.") and not name.startswith(("__", "<")):
                self.hops.add(f"{module}.{frame.f_code.co_qualname}")
                return

    def _holds(self, value: Any) -> bool:
        if isinstance(value, np.ndarray):
            some = value.ravel()[:: value.size // _MAX_LOOKED_UP + 1] if value.dtype.kind == "f" else np.zeros(0)
            near = self.numbers[np.searchsorted(self.numbers[:-1], some)]
            return bool(np.count_nonzero(near == some) >= _MIN_SHARED)
        if isinstance(value, tuple | list | dict):
            return any(map(self._holds, list(value.values() if isinstance(value, dict) else value)[:_MIN_SHARED]))
        return id(getattr(value, "__self__", value)) in self._held


def run() -> None:
    """Print the figures."""
    truth, random = squat_and_wave(rate=_RATE, duration=0.8, up="y"), np.random.default_rng(0)
    rig, worn = studio_rig(truth, cameras=2), truth.body.markers("HANIM_45")
    pixels = simulate_keypoints(truth, rig, noise_px=2.0, outliers=0.0, missing=0.0, seed=0)
    front = in_front(truth, _CAMERA.camera(), azimuth=0.4, near=_CAMERA.near, far=_CAMERA.far)
    seen = replace(truth, Ts_world_root=front.T_camera_world @ truth.Ts_world_root)
    video = simulate_depth(seen, front.with_pose(np.eye(4)), _CAMERA, room=False, seed=0)
    depth = np.stack([video.frame(i).depth for i in range(len(truth))])
    x, load = truth.positions(worn) + random.normal(0.0, 0.004, (len(truth), len(worn), 3)), random.random((99, 3))

    def keypoints(i: int) -> list[Any]:
        return [KeypointFrame.of_record(k, i, i / _RATE) for k in pixels]

    takes: dict[str, tuple[NDArray, Rig, Callable[[int], list[Any]]]] = {
        "keypoint": (np.concatenate([k.points.ravel() for k in pixels]), rig, keypoints),
        "depth": (depth, Rig((front.with_pose(np.eye(4)),)), lambda i: [DepthFrame("depth", i / _RATE, depth[i])]),
        "marker": (x, Rig(()), lambda i: [MarkerFrame("mocap", i / _RATE, worn.names, x[i], "HANIM_45")]),
        "own": (load, rig, lambda i: [*keypoints(i), Pressure(i / _RATE, load[i])]),
    }
    for kind, (numbers, cameras, frames) in takes.items():
        more: dict[str, Any] = {"on_body": ("depth",)} if kind == "depth" else {}
        sensors = (Insole(),) if kind == "own" else ()
        start = (0, (seen if kind == "depth" else truth).state(0))
        with Road(numbers[numbers != 0.0]) as road:
            steps = [frames(i) for i in range(len(truth))]
            made = Recording.of_frames(steps, cameras, rate=_RATE, up="y", start=start, sensors=sensors, **more)
            track(made, truth.body, size=False)
        figure(f"house_hops_{kind}", len(road.hops), "functions", f"<= {GOALS[kind][0]}")
        figure(f"house_types_{kind}", len(road.types), "classes", f"<= {GOALS[kind][1]}")
        print(f"# {', '.join(sorted(road.types))}\n# {', '.join(sorted(road.hops))}", flush=True)
