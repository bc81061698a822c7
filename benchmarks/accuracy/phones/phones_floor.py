"""The floor under people of whom nothing but videos is known: how level it is, its height, and whether feet slide.

`walk_ts` of `video_mono_opencap` is a walk before one camera, with markers, which tell the vertical and when an ankle
rests. The rooms of `phones_rooms` have a true floor: all their telephones, whose cameras are found from the people,
and the first telephone alone. They are the first three rooms with one person: among two, drawn as a detector sees
them, one camera does not keep them apart. The balancing trial's calibration has its own vertical; who balances stands
on a beam. The motion is laid on the truth as a whole; vertical and floor are then compared. A foot rests while its
ankle (of markers) or all points of its sole (of rooms) move less than 0.15 m/s for 0.2 s.
"""

from __future__ import annotations

import shutil
import tempfile
from itertools import count, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.people.people_one_camera import NAMES, joints_of, joints_of_file, laid_on
from benchmarks.accuracy.phones import phones_rooms
from benchmarks.accuracy.phones.phones_real import RECORDINGS, _tracked
from benchmarks.figures import amount, each, figure, recording, whole_recording
from kinefit import Motion, find_cameras, track_take
from kinefit.errors import KinefitError
from kinefit.findings import runs_of
from kinefit.fitting.smoothing.foot_contacts import soles
from kinefit.geometry import se3
from kinefit.readers.guess.folder import guess_take

_SLOW, _LEAST = 0.15, 0.2  # [m/s], [s] of a foot that rests
_GOALS = {
    "tilt": ("deg off the true vertical, median", "<= 1"), "height": ("mm off the true floor, median", "<= 10"),
    "slide": ("mm that a sole moves while it rests, median of the feet's worst", "<= 5"),
}  # fmt: skip


def run() -> None:
    """Print every figure of floors."""
    each(_of_walk, _of_rooms, _of_balancing)


def _of_walk() -> None:
    root = recording("video_mono_opencap")
    units = {"tilt": "deg off the markers' vertical", "plane": "mm, the highest ankle of a stance above the lowest"}
    trial = root / "walk_ts"
    with tempfile.TemporaryDirectory() as work:
        shutil.copy(trial / "video.mp4", Path(work, "walk.mp4"))
        Path(work, "take.toml").write_text(guess_take(Path(work)).text, encoding="utf-8")
        motion = track_take(Path(work, "take.toml"))[0]
    times, truth = joints_of_file(trial / "sample_mocap.json")
    own = joints_of(motion, 1.0)
    T, there = laid_on(own, motion.times, times, truth)
    ankles = [NAMES.index(f"talus_{side}") for side in "rl"]
    rests = np.stack([_rests(there[:, k][:, None], motion.rate) for k in ankles], axis=1)
    heights = [float(own[s:e, k, 2].mean()) for k, rest in zip(ankles, rests.T, strict=True) for s, e in runs_of(rest)]
    figure("phones_floor_walk_tilt", _tilt(T, np.array([0.0, 1.0, 0.0])), units["tilt"], "<= 1")
    figure("phones_floor_walk_plane", 1e3 * float(np.ptp(heights)), units["plane"], "<= 15")
    figure("phones_floor_walk_slide", max(_slides(motion, rests)), "mm that a sole moves while it rests, worst", "<= 5")


def _of_rooms() -> None:
    for name, cameras in (("one", 1), ("rooms", None)):
        found: dict[str, list[float]] = {what: [] for what in _GOALS}
        draws = ((k, phones_rooms.room(k)) for k in count(phones_rooms.FIRST))
        alone = ((k, draw) for k, draw in draws if len(draw.truths) == 1)
        for k, draw in islice(alone, amount(3, 1)):
            try:
                values = _of_room(draw, cameras)
            except KinefitError as error:
                print(f"# room {k}, {name}: refused: {error}", flush=True)
                continue
            print(f"# room {k}, {name}: {', '.join(f'{n} {v:.2f}' for n, v in values.items())}", flush=True)
            for what, value in values.items():
                found[what].append(value)
        for what, (unit, goal) in _GOALS.items():
            kept = [v for v in found[what] if np.isfinite(v)]
            figure(f"phones_floor_{name}_{what}", float(np.median(kept)) if kept else None, unit, goal, "no room ended")


def _of_room(draw: phones_rooms.Room, cameras: int | None) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as work:
        path = phones_rooms.write_take(draw, Path(work), known=False)
        if cameras is not None:
            lines = path.read_text(encoding="utf-8").split("\n[[camera]]")
            path.write_text("\n[[camera]]".join(lines[: 1 + cameras]), encoding="utf-8")
        motion = track_take(find_cameras(path))[0]
    truth = min(draw.truths, key=lambda one: phones_rooms.joint_errors(one, draw.start, motion)[1])
    at = np.clip(np.round((draw.start + motion.times) * phones_rooms.FINE).astype(int), 0, len(truth) - 1)
    T = se3.aligned(motion.joint_centres.reshape(-1, 3), truth.joint_centres[at].reshape(-1, 3))
    inside = at < len(truth) - 1
    x = truth.positions(soles(truth.body))[at]
    side = np.array([name[0] for name in soles(truth.body).names])
    rests = np.stack([_rests(x[:, side == s], motion.rate) & inside for s in "rl"], axis=1)
    feet = motion.positions(soles(motion.body)).reshape(-1, 3).mean(axis=0) * [1.0, 1.0, 0.0]
    ground = float(np.quantile(x[..., 2], 0.02))
    slides = _slides(motion, rests)
    return {
        "tilt": _tilt(T, np.array([0.0, 0.0, 1.0])), "height": 1e3 * abs(float(se3.apply(T, feet)[2]) - ground),
        "slide": max(slides) if slides else np.nan,
    }  # fmt: skip


def _of_balancing() -> None:
    name, videos, calibration = RECORDINGS["balancing"]
    folder, unit = whole_recording(name), "deg off the calibration's vertical"
    with tempfile.TemporaryDirectory() as work:
        _, motion, known = _tracked(folder / videos, folder / calibration, Path(work))
    frames = min(len(motion), len(known))
    x, y = (m.joint_centres[:frames].reshape(-1, 3) for m in (motion, known))
    figure("phones_floor_balancing_tilt", _tilt(se3.aligned(x, y), np.array([0.0, 0.0, 1.0])), unit, "<= 1")


def _tilt(T: NDArray, up: NDArray) -> float:
    """[deg] between our vertical z and the truth's, of the pose that lays ours on the truth."""
    return float(np.degrees(np.arccos(np.clip(T[:3, 2] @ up, -1.0, 1.0))))


def _rests(x: NDArray, rate: float) -> NDArray:
    """(F,) bool: whether all points x (F, P, 3) of a foot are slow, for long enough."""
    slow = (rate * np.linalg.norm(np.gradient(x, axis=0), axis=2) < _SLOW).all(axis=1)
    out = np.zeros(len(x), bool)
    for start, stop in runs_of(slow):
        out[start:stop] = stop - start >= _LEAST * rate
    return out


def _slides(motion: Motion, rests: NDArray) -> list[float]:
    """[mm] farthest that the middle of each foot's sole comes from its median place, for each time that it rests."""
    points = soles(motion.body)
    x, side = motion.positions(points), np.array([name[0] for name in points.names])
    out = []
    for k, s in enumerate("rl"):
        middle = x[:, side == s].mean(axis=1)
        for start, stop in runs_of(rests[:, k]):
            own = middle[start:stop]
            out.append(1e3 * float(np.linalg.norm(own - np.median(own, axis=0), axis=1).max()))
    return out
