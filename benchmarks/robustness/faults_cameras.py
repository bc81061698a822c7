"""Cameras and clocks that go wrong within a take: right, said, unsaid, blamed on others, and false alarms.

Simulated takes of four cameras at 30 Hz with MediaPipe's points (3 px of noise, 2 px of drift, 10 % outliers, 10 %
missing) of a calibration that is 0.1 degrees and 3 mm off. "Right" names the cameras and no other, the kind of fault,
and its frame within half a second where it has one; "said" names the cameras without kind or frame; "wrong" blames
another camera, or another cause; "unsaid" is no fault and no doubt.
Doubts that a camera's pose is a little off are true of these takes, and blame no one.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed.mixed_takes import DETECTOR
from benchmarks.figures import amount, figure
from benchmarks.robustness.faulty_recordings import Inputs
from benchmarks.scenes.motions import library
from benchmarks.scenes.simulated import calibrated, rows_of, turned
from kinefit import Motion
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.simulation import resampled, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.takes.check import check_take

RATE, FINE = 30.0, 5  # [Hz], and how many times as often the truth is known
NAMES = ("squat", "wash 02_10", "twists and squats 13_30", "reach 14_20")
TOLERANCE = 15  # frames
KICK = np.radians(2.0), 0.03  # [rad], [m]
QUIET = ("doubt bias", "doubt moved")
TRUE = ("bias", "moved")  # kinds of doubts that are true of every take here, whose cameras are 0.1 degrees off


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion at five times the rate of the takes, cameras, and what these saw (C, F, 33, 3) before and after a kick.

    Parameters
    ----------
    frames : F of the takes
    told : Rig of the calibration
    seen, kicked : (C, F * FINE, 33, 3) [px, px, visibility]
    """

    name: str
    frames: int
    up: str
    told: Rig
    seen: NDArray
    kicked: NDArray

    def inputs(self, rows: NDArray | None = None, told: Rig | None = None, points: NDArray | None = None) -> Inputs:
        """The take whose camera c saw in frame f what happened at rows[c, f] of the fine frames."""
        rows = self.rows() if rows is None else rows
        points = np.stack([p[r] for p, r in zip(self.seen, rows)]) if points is None else points
        return Inputs(self.name, told or self.told, tuple(points), RATE, self.up)

    def rows(self) -> NDArray:
        """(C, F) fine frames of cameras in step."""
        return np.tile(FINE * np.arange(self.frames), (len(self.told), 1))


@dataclass(frozen=True)
class Fault:
    """A wrong take: cameras that it is about, what a finding of its cause says, and its first frame, if it has one."""

    name: str
    inputs: Inputs
    cameras: frozenset[str]
    says: str
    frame: int | None = None


def _kick(camera: Camera, random: np.random.Generator) -> Camera:
    turn, shift = (size * v / np.linalg.norm(v) for size, v in zip(KICK, random.normal(size=(2, 3))))
    return camera.with_pose(se3.transform(se3.exp_so3(turn), shift) @ camera.T_camera_world)


def scene(name: str, seed: int, seconds: float = 8.0) -> Scene:
    """A motion in front of four cameras."""
    random = np.random.default_rng([48, seed])
    if name == "squat":
        truth: Motion = squat_and_wave(rate=RATE * FINE, duration=seconds, up="y")
    else:
        truth = resampled(library([name])[name], RATE * FINE)
    rig = studio_rig(truth)
    told = calibrated(rig, random)
    moved = Rig(tuple(_kick(c, random) for c in rig))
    frames = min(len(truth), round(seconds * RATE * FINE)) // FINE - 12
    return Scene(name, frames, truth.up, told, _seen(truth, rig, seed), _seen(truth, moved, seed))


def _seen(truth: Motion, rig: Rig, seed: int) -> NDArray:
    found = simulate_keypoints(truth, rig, DETECTOR, drift_px=2.0, seed=seed)
    return np.array([rows_of(k) for k in found]).astype(np.float32)


def faults(s: Scene, seed: int) -> Iterator[Fault]:
    """What is made wrong."""
    random = np.random.default_rng([49, seed])
    c, other = (int(k) for k in random.permutation(len(s.told))[:2])
    name, half, frames = s.told.names[c], s.frames // 2, s.frames
    own, both = frozenset({name}), frozenset({name, s.told.names[other]})
    for k, axis in enumerate("xyz"):
        yield Fault(f"turned about {axis}", s.inputs(told=turned(s.told, name, np.radians(3.0) * np.eye(3)[k])), own,
                    r"rotated|disagrees with")  # fmt: skip
    points = np.stack([p[r] for p, r in zip(s.seen, s.rows())])
    kicked, at = points.copy(), half + 10
    kicked[c, at:] = s.kicked[c, s.rows()[c, at:]]
    yield Fault("kicked", s.inputs(points=kicked), own, r"moved at frame (\d+)", at)
    for length in (50, frames - half):
        frozen = points.copy()
        frozen[c, half : half + length] = frozen[c, half]
        yield Fault(f"frozen for {'good' if length > 50 else length}", s.inputs(points=frozen), own,
                    r"frozen.* frames? (\d+) to", half)  # fmt: skip
    for label, slow in (("rate 5/6", 6 / 5), ("rate 51/50", 50 / 51)):
        rows = s.rows()
        rows[c] = np.round(slow * rows[c]).astype(int)
        n = min(frames, int(np.sum(rows[c] < s.seen.shape[1])))
        yield Fault(label, s.inputs(rows[:, :n]), own, r"its rate is ([\d.]+) Hz")
    rows = s.rows()
    rows[c] += 5 * FINE
    yield Fault("5 frames late", s.inputs(rows), own, r"frames \(\d+ ms\) later")
    rows = s.rows()
    rows[[c, other], half:] += 8 * FINE
    yield Fault("two late from the middle", s.inputs(rows), both, r"from frame (\d+) on", half)
    rows = s.rows()
    rows[c, half - 20 :] += 6 * FINE
    yield Fault("one late from the middle", s.inputs(rows), own, r"from frame (\d+) on", half - 20)


def outcome(fault: Fault, folder: Path) -> tuple[str, list[str]]:
    """right, said, wrong or unsaid; and what was said."""
    told = [f for f in check_take(fault.inputs.write(folder), tell=lambda _: None).findings
            if f.severity in ("fault", "doubt")]  # fmt: skip
    texts = [f"{f.severity} {f.kind}: {f.text} {f.confidence}" for f in told]
    usual = [f for f in told if f.severity == "doubt" and f.kind in TRUE and not fault.cameras & {*f.cameras}]
    told = [f for f in told if f not in usual]
    blamed = {name for f in told for name in f.cameras}
    hits = [m for f in told if (m := re.search(fault.says, f.text)) and fault.cameras & {*f.cameras}]
    frames = [int(m.group(1)) for m in hits] if fault.frame is not None else []
    if blamed - fault.cameras or any(f.kind == "focal" for f in told):
        return "wrong", texts
    in_time = fault.frame is None or any(abs(n - fault.frame) <= TOLERANCE for n in frames)
    if hits and in_time and blamed == fault.cameras:
        return "right", texts
    return ("said" if blamed else "wrong" if told else "unsaid"), texts


def run(check: Callable[[Fault, Path], tuple[str, list[str]]] = outcome) -> None:
    """Print the figures."""
    counts: dict[str, Counter[str]] = {}
    alarms, clean = 0, 0
    with tempfile.TemporaryDirectory() as where:
        for seed, name in enumerate(amount(NAMES, NAMES[:1])):
            s = scene(name, seed)
            right = Fault("right", s.inputs(), frozenset(), "^$")
            for k, fault in enumerate((right, *faults(s, seed))):
                what, told = check(fault, Path(where) / f"{seed}-{k}")
                print(f"# {name}, {fault.name} ({', '.join(sorted(fault.cameras))}, {fault.frame}): {what}", flush=True)
                print("".join(f"#     {text}\n" for text in told), end="", flush=True)
                if fault is right:
                    clean, alarms = clean + 1, alarms + sum(not text.startswith(QUIET) for text in told)
                else:
                    counts.setdefault(fault.name, Counter())[what] += 1
    for name, count in counts.items():
        print(f"# {name}: {dict(count)}")
    total = sum(counts.values(), Counter())
    for what, goal in (("right", f">= {round(0.9 * total.total())}"), ("said", f"<= {round(0.1 * total.total())}"),
                       ("wrong", "<= 0"), ("unsaid", "<= 0")):  # fmt: skip
        figure(f"faults_cameras_{what}", float(total[what]), f"of {total.total()} takes", goal)
    figure("faults_cameras_false_alarms", float(alarms), f"faults and doubts in {clean} right takes", "<= 0")
