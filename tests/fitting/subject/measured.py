"""Measurements that tests make themselves: keypoints, markers, a rope; no more than the protocol asks for."""

from dataclasses import dataclass, replace

import numpy as np
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, load_body
from kinefit.geometry.losses import geman_mcclure
from kinefit.sensors.base import Measurement, RowsOf, Sensor, Unknown
from kinefit.solving.correspondences import _kernels

ARM = load_body("arm")
ARM = replace(ARM, marker_sets={"worn": ARM.landmarks})
HUMANOID = load_body("humanoid")
RIG = rig_around((0.0, 0.0, 0.0), cameras=4)


@dataclass(frozen=True, eq=False)
class Seen(Measurement):
    """Keypoints (K, 2) of one camera."""

    sensor: str
    time: float
    points: str
    uv: np.ndarray
    sigma: float = 1.0

    def match(self, scene, reach):
        camera = np.full(len(self.uv), scene.rig.index(self.sensor))

        def rows(scene):
            points = scene.body.keypoints(self.points)
            weight = np.full(len(self.uv), self.sigma**-2)
            return replaced(scene.rows_of(_kernels.pixel_rows, 2, points, scene.rig.packed, camera, self.uv, weight))

        return RowsOf(rows)


def replaced(rows):
    return replace(rows, loss=geman_mcclure(8.0))


@dataclass(frozen=True, eq=False)
class Worn(Measurement):
    """Markers (K, 3) of a set."""

    sensor: str
    time: float
    points: str
    x: np.ndarray
    sigma: float = 0.001

    def match(self, scene, reach):
        weight = np.full(len(self.x), self.sigma**-2)
        return RowsOf(lambda s: s.rows_of(_kernels.point_rows, 3, s.body.markers(self.points), self.x, weight))


@dataclass(frozen=True, eq=False)
class Pulling(Measurement):
    """A rope from a landmark to a post that pulls and never pushes; `taut` where a load cell says that it does."""

    sensor: str
    time: float
    post: np.ndarray
    taut: bool = False
    sigma: float = 0.001

    def match(self, scene, reach):
        return RowsOf(self.rows)

    def rows(self, scene):
        hand = scene.body.landmarks.select(("r_dactylion",))
        away = self.post - scene.positions(hand)[0]
        distance = np.linalg.norm(away)
        pull = distance - scene.value(self.sensor, "length", 1.0)
        felt = self.taut or pull > 0.0
        return scene.along(hand, away[None] / distance, [pull], self.sigma if felt else np.inf)


class Rope(Sensor):
    """A rope of unknown length."""

    name, unknowns = "rope", {"length": Unknown(1.0, 0.3)}

    def prepare(self, frame, scene):
        return Pulling(self.name, *frame)


def arms(count, seed=0):
    """Postures of the arm within its limits, its shoulder at the origin."""
    random = np.random.default_rng(seed)
    tree = ARM.tree
    low, high = np.maximum(tree.lower, tree.usual - 0.8), np.minimum(tree.upper, tree.usual + 0.8)
    return [BodyState(np.eye(4), random.uniform(low, high)) for _ in range(count)]


def people(count, seed=100):
    """Postures of the humanoid near the origin."""
    out = []
    for k in range(count):
        state = posture(HUMANOID, seed + k, 0.35)
        T = np.array(state.T_world_root)
        T[:3, 3] *= 0.2
        out.append(BodyState(T, state.angles))
    return out


def shaken(states, scale=0.03, seed=0):
    """Starts near the truth."""
    random = np.random.default_rng(seed)
    out = []
    for s in states:
        delta = random.normal(scale=scale, size=6 + len(s.angles))
        if len(s.angles) == len(ARM.tree.coordinates):
            delta[:6] = 0.0
        out.append(s.retract(delta))
    return out


def pixels(body, states, rig=RIG, points="BODY_25B", noise=1.0, seed=0):
    """Steps of four cameras."""
    random = np.random.default_rng(seed)
    steps = []
    for k, state in enumerate(states):
        x = body.positions(state, body.keypoints(points))
        steps.append([
            Seen(c.name, k / 10, points, c.project(x) + noise * random.normal(size=(len(x), 2)), max(noise, 0.5))
            for c in rig
        ])
    return steps


def markers(body, states, points="worn", noise=0.001, seed=0):
    """Steps of a marker system."""
    random = np.random.default_rng(seed)
    steps = []
    for k, state in enumerate(states):
        x = body.positions(state, body.markers(points))
        steps.append([Worn("mocap", k / 10, points, x + noise * random.normal(size=x.shape), max(noise, 5e-4))])
    return steps
