"""People who leave and come back elsewhere: known again by size and clothes, left open, or mistaken."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.people.people_crowds import RATE, SET, along, listed, together
from benchmarks.accuracy.people.people_real import take_of
from benchmarks.accuracy.people.people_simulated import owners_of
from benchmarks.figures import amount, each, figure, quick, whole_recording
from kinefit.bodies import Body, load_body
from kinefit.bodies.motion import Motion
from kinefit.fitting.multiview.likeness import ImageSource, joints_of
from kinefit.fitting.multiview.people import PersonTrack, people_of
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.observations import Keypoints
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.take.videos import TakePictures
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.movements import movement
from kinefit.takes.missing import prepared
from kinefit.takes.preparing import detecting

SEEDS = amount(tuple(range(200, 220)), (200,))  # the odds were settled on 100 to 114
_BEFORE, _AFTER = 2.0, 2.0  # [s] in view before and after
_AWAY = 3.0, 10.0  # [s]
_SMALLER = 3  # than the calibration's image
_MOVEMENTS = ("wave", "clap", "squat", "bow", "point")
# Shirts and trousers that people wear, RGB: two in five wear black, navy or grey, as people do.
_WORN = (
    (25, 25, 28), (30, 32, 60), (120, 122, 125), (235, 235, 232), (160, 30, 40), (60, 90, 160), (190, 150, 60),
    (40, 110, 70), (90, 60, 40), (200, 120, 150),
)  # fmt: skip
_OFTEN = (0.15, 0.12, 0.13, 0.12, 0.1, 0.12, 0.06, 0.08, 0.07, 0.05)


@dataclass(frozen=True, eq=False)
class Scene:
    """People who leave and come back.

    Parameters
    ----------
    rig : Rig
    keypoints : records, in an order that changes from frame to frame
    order : of each record (F, P), the place of each person in the list
    there : (F, P) bool, who is in the room
    gone : numbers of those who leave
    back : frame from which they are there again
    pictures : of the cameras
    """

    rig: Rig
    keypoints: tuple[Keypoints, ...]
    order: tuple[NDArray, ...]
    there: NDArray
    gone: tuple[int, ...]
    back: int
    pictures: ImageSource


def scene(kind: str, seed: int) -> Scene:
    """One person stays; of the others one leaves and comes back elsewhere, or two do and come back exchanged.

    "stranger": one leaves, and another comes. "twins": two of one size in the same clothes come back exchanged.
    """
    random = np.random.default_rng(seed)
    body = load_body("humanoid")
    bodies = [_adult(body, random) for _ in range(3)]
    worn = [tuple(_WORN[k] for k in random.choice(len(_WORN), 2, p=_OFTEN)) for _ in bodies]
    if kind == "twins":
        bodies[2], worn[2] = bodies[1], worn[1]
    away = random.uniform(*_AWAY)
    left, back = round(_BEFORE * RATE), round((_BEFORE + away) * RATE)
    frames = back + round(_AFTER * RATE)
    there = np.ones((frames, 3), bool)
    gone = (1,) if kind in ("elsewhere", "stranger") else (1, 2)
    for k in gone:
        there[left:back, k] = False
    if kind == "elsewhere":
        there[:, 2] = False
    if kind == "stranger":
        there[back:, 1], there[:back, 2] = False, False
    turn = random.uniform(-np.pi, np.pi)
    places = np.array([[1.3 * np.cos(turn + a), 1.3 * np.sin(turn + a)] for a in 2 * np.pi * np.arange(3) / 3])
    motions = []
    for k, own in enumerate(bodies):
        path = np.column_stack([np.tile(places[k], (frames, 1)), np.full(frames, random.uniform(-np.pi, np.pi))])
        if k:
            path[back:, :2] = places[3 - k] + random.uniform(-0.2, 0.2, 2)
            path[back:, 2] = random.uniform(-np.pi, np.pi)
        motions.append(along(movement(str(random.choice(_MOVEMENTS)), own, rate=RATE), path, frames))
    rig = studio_rig(together(motions), cameras=4)
    each = [simulate_keypoints(m, rig, SET, drift_px=3.0, seed=100 * seed + k) for k, m in enumerate(motions)]
    records, orders = listed(motions, rig, each, there, random)
    return Scene(rig, records, orders, there, gone, back, _drawn(motions, rig, there, worn, seed))


def _adult(body: Body, random: np.random.Generator) -> Body:
    """Somebody of a usual stature, every bone 3.5 % longer or shorter than goes with it."""
    stature = np.clip(random.normal(1.70, 0.09), 1.48, 2.0)
    factors = stature / body.stature * (1.0 + random.normal(scale=0.035, size=len(body.scale_groups)))
    return body.scaled(factors)


def _drawn(motions: list[Motion], rig: Rig, there: NDArray, worn: list[tuple], seed: int) -> ImageSource:
    """Pictures of people as trunks and legs in the colours of their clothes, the nearer before the farther.

    Cameras differ in exposure (15 %) and white (6 %); light differs by place (12 %); cloth has folds.
    """
    random = np.random.default_rng(seed + 5000)
    gain = 1.0 + random.normal(scale=0.15, size=(len(rig), 1)) + random.normal(scale=0.06, size=(len(rig), 3))
    x = [m.positions(m.body.keypoints(SET)) for m in motions]
    at = joints_of(motions[0].body.keypoints(SET).names)

    def picture(name: str, frame: int) -> tuple[NDArray, ImageFrame]:
        c = rig.index(name)
        camera = rig[name]
        size = camera.size[0] // _SMALLER, camera.size[1] // _SMALLER
        scaled = ImageFrame.scaled(camera.size, size)
        image = np.full((size[1], size[0], 3), (150, 155, 150), np.float32)
        away = [np.linalg.norm(points[frame].mean(axis=0) - camera.centre_world) for points in x]
        for k in sorted(np.flatnonzero(there[frame]), key=lambda k: -away[k]):
            uv = scaled.from_calibration(camera.project(x[k][frame]))
            light = gain[c] * (1.0 + 0.12 * np.sin(2.0 * x[k][frame].mean(axis=0)[0] + c))
            shirt, trousers = ((light * colour).tolist() for colour in worn[k])
            thick = max(round(0.15 * camera.matrix[0, 0] / away[k] / _SMALLER), 1)
            for side in "lr":
                for a, b in (("hip", "knee"), ("knee", "ankle")):
                    ends = (uv[at[side, part]].round().astype(int).tolist() for part in (a, b))
                    cv2.line(image, *ends, trousers, thick)
            trunk = [at["l", "shoulder"], at["r", "shoulder"], at["r", "hip"], at["l", "hip"]]
            cv2.fillConvexPoly(image, uv[trunk].round().astype(np.int32), shirt)
        noise = np.random.default_rng([seed, c, frame]).normal(scale=12.0, size=(size[1] // 4 + 1, size[0] // 4 + 1))
        folds = cv2.resize(noise.astype(np.float32), size)
        return np.clip(image + folds[..., None], 0, 255).astype(np.uint8), scaled

    return picture


KINDS = ("elsewhere", "exchanged", "stranger", "twins")


def judged(seen: Scene, people: list[PersonTrack]) -> tuple[int, int, int]:
    """How many of those who left are known again, left open, and taken for another."""
    after = np.arange(len(seen.there)) >= seen.back
    of = []
    for one in people:
        whose = owners_of(seen.order, one.chosen)
        of.append(tuple(
            np.bincount(w[w >= 0], minlength=seen.there.shape[1]).argmax() if (w := whose[:, part]).max() >= 0 else -1
            for part in (~after, after)
        ))  # fmt: skip
    known = sum((k, k) in of for k in seen.gone)
    wrong = sum(a >= 0 and b >= 0 and a != b for a, b in of)
    return known, len(seen.gone) - known - wrong, wrong


def _real() -> None:
    """The two people of four real videos, cut: both vanish for so long, and lists then have them in another order."""
    name, unit, goal = "people_return_real", "of 2 people and 2 absences known again", "== 4"
    videos = whole_recording("video_two_people_4cam")
    detecting.networks(None, print)
    known = 0
    with tempfile.TemporaryDirectory() as folder:
        take = prepared(read_take(take_of(videos, videos / "Calib.qca.txt", Path(folder) / "two")))
        seen = load_observations(take)
        assert seen.rig is not None
        whole = people_of(seen.rig, seen.keypoints)
        half = len(seen.keypoints[0]) // 2
        for seconds in (3.0, 10.0):
            gap = round(seconds * seen.rate)
            records = [_cut(k, half, gap) for k in seen.keypoints]
            with TakePictures(take, seen) as pictures:
                own: ImageSource = lambda c, f, gap=gap: pictures(c, f if f < half else f - gap)
                found = people_of(seen.rig, records, own)
            known += sum(any(_is_same(one, other, records, half, gap) for other in found) for one in whole)
    figure(name, float(known), unit, goal)


def _cut(record: Keypoints, half: int, gap: int) -> Keypoints:
    """A record with nobody in it for some frames in the middle, and the list turned round after them."""
    shape = len(record) + gap, *record.points.shape[1:]
    points, confidence = np.full(shape, np.nan), np.zeros(shape[:3])
    points[:half], confidence[:half] = record.points[:half], record.confidence[:half]
    points[half + gap :], confidence[half + gap :] = record.points[half:, ::-1], record.confidence[half:, ::-1]
    return replace(record, points=points, confidence=confidence, lifted=None)


def _is_same(whole: PersonTrack, cut: PersonTrack, records: list[Keypoints], half: int, gap: int) -> bool:
    """Whether somebody of the cut record has the detections of one of the whole record."""
    same = []
    for record, own, other in zip(records, whole.chosen, cut.chosen):
        turned = np.where(own >= 0, record.points.shape[1] - 1 - own, -1)
        same += [other[:half] == own[:half], other[half + gap :] == turned[half:]]
    return all(np.mean(s) > 0.9 for s in same)


def run() -> None:
    """Print every figure."""
    each(_real)
    of: dict[tuple[str, bool], NDArray] = {}
    by: dict[str, Callable[[Scene], ImageSource | None]] = {
        "size": lambda s: None, "size and clothes": lambda s: s.pictures,
    }  # fmt: skip
    for kind in KINDS[:1] if quick() else KINDS:
        told = {way: np.zeros(3, int) for way in by}
        for seed in SEEDS:
            seen = scene(kind, seed)
            for way, pictures in by.items():
                told[way] += judged(seen, people_of(seen.rig, seen.keypoints, pictures(seen)))
        for way, (known, open_, wrong) in told.items():
            of[kind, way == "size"] = told[way]
            print(f"# {kind}, by {way}: {known} known again, {open_} left open, {wrong} taken for another", flush=True)
    for size, name in ((False, "people_return"), (True, "people_return_size")):
        real = sum(of[kind, size] for kind in ("elsewhere", "exchanged") if (kind, size) in of)
        figure(f"{name}_right", 100 * real[0] / real.sum(), "% of those who come back", ">= 90")
        figure(f"{name}_wrong", 100 * real[2] / real.sum(), "% of those who come back", "<= 1")
        for kind in ("stranger", "twins"):
            if (kind, size) in of:
                figure(f"{name}_{kind}", 100 * of[kind, size][2] / of[kind, size].sum(), "% taken for another", "<= 5")
