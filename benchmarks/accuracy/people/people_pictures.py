"""Pictures of hard cases of several people, simulated.

`python -m benchmarks.accuracy.people.people_pictures people.jpg` draws them.

Each is tracked as by the command: keypoints of four cameras in half a circle, with 3 px of noise, 10 % outliers, 10 %
missing. Grey are the detections of one camera, in colour the bodies that were fitted, each with its number.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.people.people_crowds import RATE, SET, along, hidden
from kinefit import load_body
from kinefit.bodies.motion import Motion
from kinefit.errors import KinefitError
from kinefit.fitting.multiview.followed import PersonKeypoints, sentences
from kinefit.fitting.multiview.people import people_of
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import Keypoints
from kinefit.simulation import simulate_keypoints
from kinefit.simulation.figures import look_at
from kinefit.simulation.movements import movement
from kinefit.simulation.movements import people as persons

FRAMES, SHOWN, TILE, _WIDE = 100, 34, (384, 320), 5
GONE, BACK, EARLY, LATE = 33, 67, 20, 80  # frames in which those who leave are away, and two in which they are drawn
COLOURS = ((60, 180, 255), (255, 150, 40), (90, 210, 90), (220, 90, 220), (60, 60, 235), (200, 200, 40))
Pixels = tuple[NDArray, NDArray]  # (F, K, 2) [px] and (F, K) of one person in one camera
Case = tuple[Rig, list[list[Pixels]], int | str | None]  # rig, [camera][person], who is asked for


def main(out: Path) -> None:
    """Write the picture, and print what was said of each case."""
    tiles = [_tile(name, make) for name, make in CASES.items()]
    while len(tiles) % _WIDE:
        tiles.append(np.full_like(tiles[0], 255))
    cv2.imwrite(str(out), np.vstack([np.hstack(tiles[k : k + _WIDE]) for k in range(0, len(tiles), _WIDE)]))


def _rig(away: float = 4.2) -> Rig:
    """Four cameras in half a circle, which all see the wall behind."""
    cameras = []
    for k, turn in enumerate(np.radians((25.0, 70.0, 110.0, 155.0))):
        eye = np.array([away * np.cos(turn), 1.5, away * np.sin(turn)])
        T = look_at(eye, np.array([0.2, 0.9, 0.0]), np.array([0.0, 1.0, 0.0]))
        matrix = np.array([[720.0, 0.0, 639.5], [0.0, 720.0, 479.5], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"cam{k + 1:02d}", (1280, 960), matrix, T_camera_world=T))
    return Rig(tuple(cameras))


def _someone(
    seed: int, name: str, x: float = 0.0, z: float = 0.0, turn: float = 0.0, to: float | None = None
) -> Motion:
    """A person who stands at a place (x, z) [m], or goes from there to another x."""
    body = persons(load_body("humanoid"), count=1, seed=seed)[0].body
    px = np.linspace(x, x if to is None else to, FRAMES)
    path = np.column_stack([px, np.full(FRAMES, z), np.full(FRAMES, turn)])
    return along(movement(name, body, rate=RATE), path, FRAMES)


def _seen(motions: Sequence[Motion], rig: Rig) -> list[list[Pixels]]:
    """What every camera sees of everybody, less what others hide."""
    there = np.ones((FRAMES, len(motions)), bool)
    each = [simulate_keypoints(m, rig, SET, seed=k) for k, m in enumerate(motions)]
    out = []
    for c, camera in enumerate(rig):
        behind = hidden(motions, camera, there)
        out.append([
            (e[c].points[:, 0], np.where(behind[:, k], 0.0, e[c].confidence[:, 0])) for k, e in enumerate(each)
        ])  # fmt: skip
    return out


def _points(rig: Rig, x: NDArray, seed: int) -> list[Pixels]:
    """What cameras see of points (F, K, 3) [m] that are no body: an image in a mirror, a picture."""
    random, out = np.random.default_rng(seed), []
    for camera in rig:
        uv = camera.project(x) + random.normal(scale=3.0, size=(*x.shape[:2], 2))
        inside = ((uv > 0) & (uv < camera.size)).all(axis=-1) & (random.uniform(size=uv.shape[:2]) > 0.1)
        out.append((uv, np.where(inside, 0.8, 0.0)))
    return out


def _twins() -> Case:
    one, two = _someone(3, "walk", -0.9, -0.25, 0.0, 0.9), _someone(3, "walk", 0.9, 0.25, np.pi, -0.9)
    rig = _rig()
    return rig, _seen([one, two], rig), None


def _mirror() -> Case:
    """A wall mirror 0.9 m behind somebody: the image stands behind it, its left is the right."""
    one = _someone(4, "wave", 0.0, 0.0, 0.6)
    rig = _rig()
    points = one.body.keypoints(SET)
    x = one.positions(points) * [1.0, 1.0, -1.0] + [0.6, 0.0, -1.8]
    other = [points.names.index({"L": "R", "R": "L"}.get(n[0], n[0]) + n[1:]) for n in points.names]
    return rig, [[*a, b] for a, b in zip(_seen([one], rig), _points(rig, x[:, other], 7))], None


def _picture(moving: bool, size: float) -> Case:
    """Somebody before a flat picture of a person, still (a poster) or moving (a television)."""
    one, shown = _someone(5, "bow", 0.0, 0.3, np.pi / 2), _someone(6, "wave", 0.0, 0.0, -np.pi / 2)
    rig = _rig()
    x = shown.positions(shown.body.keypoints(SET))
    x = x if moving else np.repeat(x[:1], FRAMES, axis=0)
    x = size * x * [1.0, 1.0, 0.0] + [0.9, 1.5 - 1.2 * size, -1.0]  # flat, on a wall
    return rig, [[*a, b] for a, b in zip(_seen([one], rig), _points(rig, x, 8))], None


def _crowd() -> Case:
    names = ("wave", "clap", "bow", "point")
    every = [
        _someone(k, names[k % 4], 1.1 * (k % 4 - 1.5), 1.1 * (k // 4 - 1.0), 0.7 * k) for k in range(12)
    ]
    rig = _rig(away=6.5)
    return rig, _seen(every, rig), 1


def _cut() -> Case:
    """One person of whom every camera sees the upper half alone."""
    one = _someone(7, "wave")
    rig = _rig()
    low = one.positions(one.body.keypoints(SET))[..., 1] < 0.95
    return rig, [[(uv, np.where(low, 0.0, sure))] for ((uv, sure),) in _seen([one], rig)], None


def _third() -> Case:
    rig, seen, _ = _twins()
    return rig, seen, 3


def _sitting() -> Case:
    one = _someone(9, "wave")
    angles, T, tree = np.array(one.angles), np.array(one.Ts_world_root), one.body.tree
    for side in "rl":
        for name, value in (("hip_flexion", 85.0), ("knee_angle", 85.0)):
            angles[:, tree.coordinate(f"{name}_{side}")] = np.radians(value)
    T[:, 1, 3] = 0.5
    one = replace(one, angles=angles, Ts_world_root=T)
    rig = _rig()
    return rig, _seen([one], rig), None


def _returning(*sizes: float) -> Case:
    """Two who leave for 1.1 s and come back each where the other was."""
    body = load_body("humanoid")
    motions, side = [], np.where(np.arange(FRAMES) < GONE, -0.45, 0.45)
    for k, size in enumerate(sizes):
        own = body.scaled([size] * len(body.scale_groups))
        path = np.column_stack([side if k else -side, np.full(FRAMES, 0.1), np.full(FRAMES, 0.6)])
        motions.append(along(movement("wave", own, rate=RATE), path, FRAMES))
    rig = _rig()
    there = (np.arange(FRAMES) < GONE) | (np.arange(FRAMES) >= BACK)
    seen = [[(uv, np.where(there[:, None], sure, 0.0)) for uv, sure in each] for each in _seen(motions, rig)]
    return rig, seen, None


CASES: dict[str, Callable[[], Case]] = {
    "twins": _twins, "a mirror": _mirror, "a poster": lambda: _picture(False, 1.0),
    "a television": lambda: _picture(True, 0.45), "twelve, one chosen": _crowd, "cut by every edge": _cut,
    "person 3 of two": _third, "sitting all the time": _sitting,
    "two come back exchanged": lambda: _returning(0.92, 1.06), "twins come back": lambda: _returning(1.0, 1.0),
}  # fmt: skip


def _tile(name: str, make: Callable[[], Case]) -> NDArray:
    rig, seen, wanted = make()
    records = []
    for camera, each in zip(rig, seen):
        uv, sure = (np.stack([one[i] for one in each], axis=1) for i in (0, 1))
        names = load_body("humanoid").keypoints(SET).names
        records.append(Keypoints(camera.name, SET, names, RATE, uv, sure))
    began = time.process_time()
    people = people_of(rig, records)
    spent = time.process_time() - began
    camera, count = rig.cameras[1], max(len(people), 1)
    image = np.full((camera.size[1], camera.size[0], 3), 250, np.uint8)
    shown = (EARLY, LATE) if "come back" in name else (SHOWN,)
    images = [image.copy() for _ in shown]
    for own, frame in zip(images, shown):
        for uv, sure in zip(records[1].points[frame].reshape(-1, 2), records[1].confidence[frame].ravel()):
            if sure > 0 and np.isfinite(uv).all():
                cv2.circle(own, uv.astype(int).tolist(), 6, (150, 150, 150), -1)
    said = f"{len(people)} in view"
    for k in range(count) if wanted is None else [int(wanted) - 1]:
        try:
            recording = Recording.of_keypoints(rig, records, sigma=4.0, person=k + 1, people=people, up="y")
            motion = track(recording, load_body("humanoid"))
        except KinefitError as error:
            said = str(error.problem)
            continue
        for own, frame in zip(images, shown):
            if len(shown) == 1 or people[k].views[frame]:
                _draw(own, motion, camera, k, frame)
        print(f"# {name}: person {k + 1}: {_told(motion)}")
    followed = PersonKeypoints((), tuple(people), 1, RATE).as_record()
    for sentence in sentences(followed, asked=True)[1:]:
        print(f"# {name}: {sentence}")
    print(f"# {name}: {said}; who is who in {FRAMES} frames: {spent:.2f} s of CPU", flush=True)
    return _titled(images, f"{name}: {said}")


def _told(motion: Motion) -> str:
    x = motion.positions()
    tall = motion.body.stature or 0.0
    seen = np.mean(np.isfinite(motion.joint_std).all(axis=(0, 2)))
    speed = float(np.median(np.linalg.norm(np.diff(x, axis=0), axis=-1))) * motion.rate
    known = f"quality {motion.quality.mean():.2f}, {100 * seen:.0f} % of joints known"
    return f"{tall:.2f} m tall, {speed:.2f} m/s, {known}"


def _draw(image: NDArray, motion: Motion, camera: object, k: int, frame: int) -> None:
    """A skeleton; joints of which nothing is known are left out."""
    joints = motion.segment_poses()[frame, :, :3, 3]
    uv, known = camera.project(joints), np.isfinite(motion.joint_std[frame]).all(axis=-1)  # type: ignore[attr-defined]
    colour = COLOURS[k % len(COLOURS)]
    for s, p in enumerate(motion.body.tree.parents):
        if p >= 0 and known[s] and known[p] and np.isfinite(uv[[s, p]]).all():
            cv2.line(image, uv[p].astype(int).tolist(), uv[s].astype(int).tolist(), colour, 8, cv2.LINE_AA)
    at = uv[motion.body.tree.segments.index("head")]
    cv2.putText(image, str(k + 1), (int(at[0]) + 15, int(at[1]) - 30), 0, 2.2, colour, 6, cv2.LINE_AA)


def _titled(images: list[NDArray], text: str) -> NDArray:
    wide = 720 // len(images) // 2
    image = np.hstack([one[260:800, 640 - wide : 640 + wide] for one in images])
    scale = min(TILE[0] / image.shape[1], (TILE[1] - 30) / image.shape[0])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    out = np.full((TILE[1], TILE[0], 3), 255, np.uint8)
    left = (TILE[0] - small.shape[1]) // 2
    out[30 : 30 + small.shape[0], left : left + small.shape[1]] = small
    cv2.putText(out, text, (8, 21), 0, 0.5, (20, 20, 20), 1, cv2.LINE_AA)
    cv2.rectangle(out, (0, 0), (TILE[0] - 1, TILE[1] - 1), (200, 200, 200), 1)
    return out


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "people.jpg"))
