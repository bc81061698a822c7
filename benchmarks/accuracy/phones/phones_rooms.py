"""Simulated rooms with telephones of which nothing is known: cameras, clocks and motion from the people in view.

Recorded motions before two to eight telephones: anywhere around at 2.5 to 6 m, at 0.6 to 2.2 m of height, lying or
standing, fields of view of 64 degrees with a deviation of 8, started up to two seconds apart, 25 to 60 frames a second,
2 to 20 s; in three rooms of ten a second person. What the detector saw is drawn: keypoints with noise that lasts, and
landmarks lifted to space, turned by some 8 degrees in each camera, of another size, with 3 cm of noise, 6 cm along the
view. They are written as the detector writes them; all else is `track_take` with its defaults, as `kinefit track` calls
it, on a take with videos' sizes and the person's height. Settings were chosen on draws 0 to 9; of
draws 10 to 23, which were printed before, two had clocks of another period, which made one rule more.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.scenes.motions import library
from kinefit import Keypoints, Motion, find_cameras, track_take
from kinefit.errors import KinefitError
from kinefit.exporters.motion_file import write_detections
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import Detections
from kinefit.readers.calibration.read import FoundCameras, read_found, write_calibration
from kinefit.readers.landmarks.keypoint_sets import MEDIAPIPE_33
from kinefit.simulation import cut, known_motion, resampled, simulate_keypoints
from kinefit.simulation.evaluation import angle_errors
from kinefit.simulation.figures import look_at
from kinefit.simulation.keypoints import drift
from kinefit.takes.missing import cameras_file

FIRST, ROOMS = amount(40, 44), amount(30, 1)
FINE = 120.0  # [Hz] at which the truth is known
NOISE = {"noise_px": 3.0, "drift_px": 5.0, "outliers": 0.03, "missing": 0.05}
TURNED, LATERAL, DEEP, LASTS = 8.0, 0.03, 0.06, 0.5  # [deg], [m], [m], [s] of the lifted landmarks
SHORT, LONG = 2.0, 20.0  # [s]


@dataclass(frozen=True, eq=False)
class Room:
    """One draw: who moved, the true cameras, how late each clock is [s], and what each camera's detector saw."""

    truths: tuple[Motion, ...]  # at FINE
    start: float  # [s] of the first camera's first frame in them
    rig: Rig
    late: NDArray
    seen: tuple[Detections, ...]


@dataclass(frozen=True)
class Score:
    """Errors of one room: cameras [deg], lenses [%], scale [%], clocks [frames], joints [mm] and angles [deg]."""

    rotation: float
    focal: float
    scale: float
    clock: float
    joints: float
    known: float
    angles: float
    inside: float


def room(draw: int) -> Room:
    """A room; the same number gives the same."""
    random = np.random.default_rng([34, draw])
    motions = list(library().values())
    count, rate = (2 if random.random() < 0.3 else 1), float(random.choice([25, 30, 50, 60]))
    seconds = float(np.exp(random.uniform(np.log(SHORT), np.log(LONG))))
    reach = min(1.0, 0.3 * seconds)  # [s] that clocks are early or late
    truths = [_moved(motions, seconds + 2.0 * reach, 1.3 * k, random) for k in range(count)]
    rig = _telephones(truths[0], random)
    late = np.append(0.0, random.uniform(-reach, reach, len(rig) - 1))
    records = simulate_keypoints(
        truths[0], rig, "MEDIAPIPE_33", bystander=truths[1] if count > 1 else None, seed=draw, **NOISE
    )  # fmt: skip
    steps = np.arange(round(seconds * rate)) / rate
    at = [np.minimum(np.round((reach + t + steps) * FINE).astype(int), len(truths[0]) - 1) for t in late]
    seen = tuple(
        _as_detected(truths, camera, record, frames, rate, random)
        for camera, record, frames in zip(rig, records, at, strict=True)
    )
    return Room(tuple(truths), reach, rig, late, seen)


def _moved(motions: Sequence[Motion], seconds: float, aside: float, random: np.random.Generator) -> Motion:
    """One person who does one recorded movement after the other about one place, a second between them."""
    parts: list[Motion] = []
    body = motions[int(random.integers(len(motions)))].body
    while sum(len(part) for part in parts) < seconds * FINE:
        motion = resampled(motions[int(random.integers(len(motions)))].turned("z"), FINE)
        where = random.normal(0.0, 0.3, 2) + [aside, 0.0] - motion.Ts_world_root[len(motion) // 2, :2, 3]
        moved = se3.transform(np.eye(3), np.append(where, 0.0)) @ motion.Ts_world_root
        motion = known_motion(body, FINE, moved, motion.angles, up="z", name="moved")
        if parts:
            ends = [(m.Ts_world_root[f], m.angles[f]) for m, f in ((parts[-1], -1), (motion, 0))]
            Ts, angles = (np.stack(both) for both in zip(*ends))
            step = known_motion(body, 1.0, Ts, angles, up="z", name="step")
            parts.append(resampled(step, FINE))
        parts.append(motion)
    Ts, angles = (np.concatenate([getattr(part, what) for part in parts]) for what in ("Ts_world_root", "angles"))
    frames = round(seconds * FINE)
    return known_motion(body, FINE, Ts[:frames], angles[:frames], up="z", name="moved")


def _telephones(motion: Motion, random: np.random.Generator) -> Rig:
    """Two to eight telephones that look at the person, held about level."""
    x = motion.segment_poses()[..., :3, 3].reshape(-1, 3)
    middle, cameras = (x.min(axis=0) + x.max(axis=0)) / 2.0, []
    reach = float(np.linalg.norm(np.ptp(x[:, :2], axis=0))) / 2.0
    first = random.uniform(0.0, 2.0 * np.pi)
    count = int(random.integers(2, 9))
    for k in range(count):
        angle = first + 2.0 * np.pi * k / count * random.uniform(0.5, 1.0) + random.normal(0.0, 0.2)
        far = random.uniform(2.5, 5.0) + reach
        place = middle + far * np.array([np.cos(angle), np.sin(angle), 0.0])
        place[2] = random.uniform(0.6, 2.2)
        level = look_at(place, middle + random.normal(0.0, 0.15, 3), np.array([0.0, 0.0, 1.0]))
        R = se3.exp_so3(np.array([0.0, 0.0, np.radians(random.normal(0.0, 3.0))])) @ level[:3, :3]
        size = (1080, 1920) if random.random() < 0.5 else (1920, 1080)
        focal = 960.0 / np.tan(np.radians(random.normal(64.0, 8.0)) / 2.0)
        K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"phone{k + 1}", size, K, T_camera_world=se3.transform(R, -R @ place)))
    return Rig(tuple(cameras))


def _as_detected(
    truths: list[Motion], camera: Camera, record: Keypoints, frames: NDArray, rate: float,
    random: np.random.Generator,
) -> Detections:  # fmt: skip
    """What the detector would have left of one telephone's video."""
    points, confidence = record.points[frames], record.confidence[frames]
    lifted = np.full((*points.shape[:3], 3), np.nan)
    keep, size = float(np.exp(-1.0 / (rate * LASTS))), random.uniform(0.9, 1.1)
    bias = se3.exp_so3(np.radians(random.normal(0.0, TURNED / np.sqrt(3.0), 3)))
    for p in range(points.shape[1]):
        for truth in truths:
            lifted_one = _lifted(truth, camera, frames, size, bias, keep, random)
            near = _is_of(truth, camera, frames, points[:, p])
            lifted[near, p] = lifted_one[near]
    confidence = np.where(np.isfinite(points).all(axis=-1), confidence, 0.0)
    runs = np.zeros(0, np.uint32), np.zeros(points.shape[0] * points.shape[1] + 1, int)
    return Detections(camera.name, rate, camera.size, points, confidence, *runs, "simulation", lifted)


def _lifted(
    truth: Motion, camera: Camera, frames: NDArray, size: float, bias: NDArray, keep: float, random: np.random.Generator
) -> NDArray:
    """(F, 33, 3) [m] landmarks about the hips as a network would lift them; NaN beyond the truth's end."""
    points = truth.body.keypoints("MEDIAPIPE_33")
    inside = np.minimum(frames, len(truth) - 1)
    x = se3.apply(camera.T_camera_world, truth.positions(points)[inside])
    hips = x[:, [points.names.index("left_hip"), points.names.index("right_hip")]].mean(axis=1, keepdims=True)
    crop = se3.shortest_turn(np.array([0.0, 0.0, 1.0]), hips[:, 0])
    own = size * np.einsum("ji,fkj->fki", bias, np.einsum("fji,fkj->fki", crop, x - hips))
    own = own + np.array([LATERAL, LATERAL, DEEP]) * drift(own.shape, keep, random)
    out = np.full((len(frames), 33, 3), np.nan)
    out[:, [MEDIAPIPE_33.index(name) for name in points.names]] = own
    out[frames >= len(truth)] = np.nan
    return out


def _is_of(truth: Motion, camera: Camera, frames: NDArray, uv: NDArray) -> NDArray:
    """(F,) whether a column of the record is this person in a frame."""
    points = truth.body.keypoints("MEDIAPIPE_33")
    columns = [MEDIAPIPE_33.index(name) for name in points.names]
    true = camera.project(truth.positions(points)[np.minimum(frames, len(truth) - 1)])
    with np.errstate(all="ignore"):
        away = np.nanmedian(np.linalg.norm(uv[:, columns] - true, axis=-1), axis=1)
    return away < 60.0


def write_take(draw: Room, folder: Path, *, known: bool) -> Path:
    """The take of a room, as kinefit init writes it, or with the true calibration and clocks."""
    lines = ["[take]", 'name = "room"', f"rate = {draw.seen[0].rate:g}", 'up = "z"']
    lines += [f"height = {draw.truths[0].body.stature:.4f}"]
    if known:
        write_calibration(draw.rig, folder / "true.toml")
        lines += ["", "[calibration]", 'file = "true.toml"', "position_sigma = 0.0", "rotation_sigma = 0.0"]
    for seen, late in zip(draw.seen, draw.late, strict=True):
        write_detections(seen, folder / f"{seen.camera}.npz")
        lines += ["", "[[camera]]", f'name = "{seen.camera}"', f"size = [{seen.size[0]}, {seen.size[1]}]"]
        lines += [f"time_offset = {late:.6f}"] if known else []
        lines += ["", "[[keypoints]]", f'camera = "{seen.camera}"', 'format = "detect"', f'file = "{seen.camera}.npz"']
    path = folder / f"{'known' if known else 'take'}.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def score(draw: Room) -> Score:
    """Track a room with nothing known, and with everything."""
    with tempfile.TemporaryDirectory() as work:
        path = write_take(draw, Path(work), known=False)
        motion = track_take(find_cameras(path))[0]
        found = read_found(cameras_file(path))
        assert found is not None
        known = track_take(write_take(draw, Path(work), known=True))[0]
    truth = min(draw.truths, key=lambda one: joint_errors(one, draw.start, motion)[1])
    scale, joints, inside = joint_errors(truth, draw.start, motion)
    first = round((motion.times[0] - known.times[0]) * motion.rate)
    both = min(len(motion) + min(first, 0), len(known) - max(first, 0))
    one, other = cut(motion, max(-first, 0), max(-first, 0) + both), cut(known, max(first, 0), max(first, 0) + both)
    angles = float(np.nanmean(np.abs(angle_errors(one, other))))
    return Score(*camera_errors(found.rig.select(draw.rig.names), draw.rig), scale, clock_error(found, draw), joints,
                 joint_errors(truth, draw.start, known)[1], angles, inside)  # fmt: skip


def turns_between(found: Rig, truth: Rig) -> list[float]:
    """[deg] by which the turn from one camera to another is off, for all pairs."""
    turns = []
    for a, b in combinations(range(len(truth)), 2):
        R, Q = (r.cameras[b].T_camera_world[:3, :3] @ r.cameras[a].T_camera_world[:3, :3].T for r in (found, truth))
        turns.append(float(np.degrees(np.linalg.norm(se3.log_so3(R.T @ Q)))))
    return turns


def camera_errors(found: Rig, truth: Rig) -> tuple[float, float]:
    """Median turn between two cameras [deg] and median focal length [%] off the truth."""
    lens = [100 * abs(a.matrix[0, 0] / b.matrix[0, 0] - 1) for a, b in zip(found, truth, strict=True)]
    return float(np.median(turns_between(found, truth))), float(np.median(lens))


def clock_error(found: FoundCameras, draw: Room) -> float:
    """Median clock off the truth [frames]."""
    late = dict(zip(found.rig.names, found.time_offsets, strict=True))
    away = [abs(late[n] - late[draw.rig.names[0]] - t) for n, t in zip(draw.rig.names, draw.late, strict=True)]
    return float(np.median(away[1:])) * draw.seen[0].rate


def joint_errors(truth: Motion, start: float, motion: Motion) -> tuple[float, float, float]:
    """Scale off [%]; joints off [mm], laid on as a whole; share of coordinates within 1.96 stated deviations."""
    at = np.clip(np.round((start + motion.times) * FINE).astype(int), 0, len(truth) - 1)
    x, y = motion.segment_poses()[..., :3, 3], truth.segment_poses()[at][..., :3, 3]
    middle, aim = x.reshape(-1, 3).mean(axis=0), y.reshape(-1, 3).mean(axis=0)
    T = se3.aligned(x.reshape(-1, 3), y.reshape(-1, 3))
    away = se3.apply(T, x) - y
    scale = np.sum((y - aim) * ((x - middle) @ T[:3, :3].T)) / np.sum((x - middle) ** 2)
    std = motion.joint_std
    known = np.isfinite(std) & (std > 0)
    local = np.einsum("ji,fsj->fsi", T[:3, :3], away)
    inside = float(np.mean(np.abs(local[known]) <= 1.96 * std[known])) if known.any() else np.nan
    return 100 * abs(1 / scale - 1), 1e3 * float(np.linalg.norm(away, axis=-1).mean()), 100 * inside


def run() -> None:
    """Print every figure of rooms with telephones."""
    scores: list[Score] = []
    for k in range(FIRST, FIRST + ROOMS):
        draw = room(k)
        what = f"# room {k}: {len(draw.rig)} telephones, {len(draw.truths)} people, {len(draw.seen[0].points)} frames"
        try:
            scores.append(one := score(draw))
        except KinefitError as error:
            print(f"{what}: refused: {error}", flush=True)
            continue
        print(f"{what}: turn {one.rotation:.2f} deg, focal {one.focal:.1f} %, scale {one.scale:.1f} %, clock "
              f"{one.clock:.2f} frames, joints {one.joints:.1f} mm of {one.known:.1f} known, angles {one.angles:.2f} "
              f"deg, {one.inside:.1f} % inside", flush=True)  # fmt: skip
    figure("phones_rooms_ended", 100 * len(scores) / ROOMS, "% of rooms", ">= 95", "no room")

    def said(name: str, values: list[float], unit: str, goal: str) -> None:
        figure(f"phones_rooms_{name}", float(np.median(values)) if values else None, unit, goal, "no room ended")

    said("rotation", [s.rotation for s in scores], "deg between two cameras, median", "<= 0.5")
    said("focal", [s.focal for s in scores], "%, median", "<= 2")
    said("scale", [s.scale for s in scores], "%, median", "<= 1.5")
    said("clock", [s.clock for s in scores], "frames, median", "<= 0.2")
    said("joints", [s.joints / s.known for s in scores], "x the error with the true calibration, median", "<= 1.25")
    said("angles", [s.angles for s in scores], "deg from those with the true calibration, median", "<= 0.5")
    said("inside_least", [s.inside for s in scores], "% within 95 % bars, median", ">= 90")
    said("inside_most", [s.inside for s in scores], "% within 95 % bars, median", "<= 98")
