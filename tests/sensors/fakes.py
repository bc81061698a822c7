"""Seven sensors of someone's own, each a dozen lines on the protocol of `kinefit.sensors.base`, and the takes they see.

All see the same wave: markers hold all of the body but its wrists, and each fake tells of a wrist what they do not.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from tests.fitting.tracking.movements import BODY, RATE, a_motion, a_rig, images, marker_frame

from kinefit.observations import DepthFrame
from kinefit.sensors.base import Measurement, RowsOf, Sensor, Unknown
from kinefit.sensors.visibility.occlusion import depth_behind
from kinefit.solving.correspondences import point_rows
from kinefit.solving.rows import PairRows

HELD = (
    "neck", "hip_centre", "nose_tip", "r_hip", "l_hip", "r_shoulder", "l_shoulder", "r_elbow", "l_elbow", "r_knee",
    "l_knee", "r_ankle", "l_ankle",
)  # fmt: skip
POST = np.array([0.5, 2.2, -0.5])
WALL = 4.0  # [m]


@dataclass(frozen=True)
class Seen:
    """A frame of a sensor of one's own."""

    sensor: str
    time: float
    value: Any = None


@dataclass(eq=False)
class Told(Measurement):
    """A measurement of a fake: its value, and the function of it that makes a match."""

    sensor: str
    time: float
    value: Any
    matches: Any
    settled: bool = True
    learnt: Any = None

    def match(self, scene, reach):
        return self.matches(self, scene, reach)


def one(name):
    """A landmark as a point set of one."""
    return BODY.landmarks.select((name,))


def truth(i, name):
    """(3,) [m] where a landmark is at a step, which need not be whole."""
    k, part = int(i), i - int(i)
    state = a_motion().state(k)
    if part:
        state = state.retract(part * state.difference(a_motion().state(k + 1)))
    return BODY.positions(state, one(name))[0]


class Level(Sensor):
    """1. Learns as it goes: the height of a hand, with an offset that it takes from steps that were accepted."""

    name = "level"

    def __init__(self):
        self.offset, self.learnt = 0.0, []

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, frame.value, self.match, learnt=self.offset)

    @staticmethod
    def match(m, scene, reach):
        up = [0.0, 1.0, 0.0]
        height = lambda s: s.position("r_wrist")[1]
        return RowsOf(lambda s: s.along(one("r_wrist"), up, [m.value - m.learnt - height(s)], 0.05))

    def learn(self, measurement, scene, sure):
        if sure:
            gap = measurement.value - scene.position("r_wrist")[1]
            self.offset, self.learnt = self.offset + 0.3 * (gap - self.offset), [*self.learnt, measurement.time]


class Strut(Sensor):
    """2. A closure: a rod of unknown length from a wrist to the other hip."""

    name, ends = "strut", ("l_wrist", "r_hip")

    def __init__(self, std=0.2):
        self.unknowns = {"length": Unknown(0.5, std)}

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, None, lambda m, scene, reach: RowsOf(self.rows))

    def rows(self, scene):
        ends = scene.body.landmarks.select(self.ends)
        a, b = scene.positions(ends)
        n = (b - a) / np.linalg.norm(b - a)
        short = n @ (b - a) - scene.value(self.name, "length", 0.5)
        return PairRows(ends.segments[None], a[None], b[None], n[None], np.array([short]), np.array([0.002**-2]))


class Rope(Sensor):
    """3. From a post to a hand, so much paid out beside a length that is not known: it pulls, and never pushes."""

    name, unknowns = "rope", {"length": Unknown(0.3, 0.2)}

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, frame.value, lambda m, s, reach: RowsOf(self.rows, {"paid": m.value}))

    def rows(self, scene, paid):
        length, taut = paid
        away = POST - scene.position("r_wrist")
        beyond = np.linalg.norm(away) - length - scene.value(self.name, "length", 0.3)
        sigma = 0.003 if taut or beyond > 0 else np.inf
        return scene.along(one("r_wrist"), away / np.linalg.norm(away), [beyond], sigma)


class Clock(Sensor):
    """4. A marker on a hand whose own clock is late by what is not known."""

    name, unknowns = "clock", {"delay": Unknown(0.0, 0.02)}

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, frame.value, lambda m, s, reach: RowsOf(partial(self.rows, m)))

    def rows(self, m, scene):
        then = scene.at_time(m.time - scene.value(self.name, "delay", 0.0))
        return point_rows(then.body, then.state, one("r_wrist"), m.value, sigma=0.003)


class Beacons(Sensor):
    """5. A hand of everybody in the room: the body's own is the one that no other body is nearer to."""

    name = "beacons"

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, frame.value, self.match)

    @staticmethod
    def match(m, scene, reach):
        at = np.array([s.position("r_wrist") for s in (scene, *scene.others)])
        near = np.linalg.norm(m.value[:, None] - at, axis=-1)
        mine = np.where(near.argmin(axis=1) == 0, near[:, 0], np.inf)
        x, found = m.value[[mine.argmin()]], np.isfinite(mine.min())
        return RowsOf(lambda s: point_rows(s.body, s.state, one("r_wrist"), x, sigma=0.005) if found else [], labels=x)


class Unnamed(Sensor):
    """6. Markers without names: labels by the least sum of squares."""

    name, names = "unnamed", ("r_wrist", "l_wrist", "r_elbow", "l_elbow", "nose_tip")

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, frame.value, self.match)

    def match(self, m, scene, reach):
        points = scene.body.landmarks.select(self.names)
        near = np.linalg.norm(m.value - scene.positions(points)[:, None], axis=-1)
        label, own = linear_sum_assignment(np.minimum(near, 0.3) ** 2)
        x = np.full((len(points), 3), np.nan)
        x[label] = np.where(near[label, own, None] < 0.3, m.value[own], np.nan)
        rows = lambda s: point_rows(s.body, s.state, points, x, sigma=0.005)
        return RowsOf(rows, labels=x, channels=self.names)


class Pixel(Sensor):
    """7. A hand in the depth camera's own image, left out where depth saw something well in front of it."""

    name = "pixel"

    def prepare(self, frame, scene):
        return Told(self.name, frame.time, frame.value, self.match)

    @staticmethod
    def match(m, scene, reach):
        x = scene.positions(one("l_wrist"))
        seen = [d for other in scene.measurements if (d := other.depth_image()) is not None]
        if any(depth_behind(x, d)[0] > 0.15 for d in seen):
            return RowsOf(lambda s: [])
        camera = scene.rig["depth"]

        def rows(s):
            z = (s.positions(one("l_wrist")) @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3])[0]
            gap = (m.value - camera.project(s.positions(one("l_wrist")))[0]) * z / camera.matrix[0, 0]
            across = camera.T_camera_world[:2, :3]
            two = one("l_wrist").select(("l_wrist", "l_wrist"))
            return s.along(two, across, gap, 0.01, group=np.zeros(2, int))

        return RowsOf(rows, labels=1)


def board(i):
    """A depth image with a board in front of the left forearm."""
    u, v = a_rig()["depth"].project(truth(i, "l_wrist")[None])[0].round().astype(int)
    depth = np.array(images()[i])
    depth[v - 8 : v + 9, u - 5 : u + 6] = np.minimum(depth[v - 8 : v + 9, u - 5 : u + 6], 1.2)
    return DepthFrame("depth", i / RATE, depth)


FAKES = {kind.name: kind for kind in (Level, Strut, Rope, Clock, Beacons, Unnamed, Pixel)}
OFFSET, LENGTH, ROPE, DELAY = 0.12, float(np.linalg.norm(truth(0, "l_wrist") - truth(0, "r_hip"))), 0.4, 0.02
AWAY = np.array([0.25, 0.1, 0.0])  # of the second person from the first


def other_wrist(i):
    """(3,) [m] of the second person, who waves five frames later."""
    return truth(max(i - 5, 0), "r_wrist") + AWAY


def value(name, i):
    """What a fake sees at a step."""
    noise = 0.003 * np.random.default_rng([i, len(name)]).normal(size=(6, 3))
    wrist = truth(i, "r_wrist")
    if name == "level":
        return wrist[1] + OFFSET
    if name == "rope":
        taut = i % 3 != 2
        return float(np.linalg.norm(POST - wrist)) - ROPE + (0.0 if taut else 0.3), taut
    if name == "clock":
        return truth(max(i - DELAY * RATE, 0), "r_wrist")[None] + noise[:1]
    if name == "beacons":
        return np.array([other_wrist(i), wrist]) + noise[:2]
    if name == "unnamed":
        x = np.array([*(truth(i, n) for n in Unnamed.names), [1.0, 2.0, 1.0]]) + noise
        return x[np.random.default_rng(i).permutation(6)]
    if name == "pixel":
        return a_rig()["depth"].project(truth(i, "l_wrist")[None])[0] + [12.0, 0.0]  # a detector's guess
    return None


@cache
def steps(name, count=24, wrist=12):
    """What markers and a fake see; the markers of the wrists are there in the first frames."""
    out = []
    for i in range(count):
        names = HELD if i >= wrist else (*HELD, "r_wrist", "l_wrist")
        frames = [replace(marker_frame(i, names), time=i / RATE), Seen(name, i / RATE, value(name, i))]
        out.append([*frames, board(i)] if name == "pixel" else frames)
    return out
