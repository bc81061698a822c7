"""A sensor of one's own: a rope from a hand to a post, which pulls and never pushes, and whose length is not known.

Two cameras and the rope find its length; then one camera, which cannot tell how far away a hand is, and the rope track.

    python examples/07_own_sensor.py
"""

from dataclasses import dataclass

import numpy as np

from kinefit import BodyState, Tracker, TrackSettings, levenberg_marquardt, load_body
from kinefit.correspondences import prior_rows
from kinefit.frame.routing import Sensors
from kinefit.observations import KeypointFrame
from kinefit.sensors.base import Measurement, RowsOf, Sensor, Unknown
from kinefit.sensors.scene import Scene
from kinefit.simulation import studio_rig
from kinefit.subject.fit import fit_subject
from kinefit.subject.sensor_parameters import OwnUnknowns

POST, LENGTH, SHOULDER, SLOW = np.array([0.9, 1.7, 0.9]), 0.8, np.eye(4), TrackSettings(angle_acceleration=60.0)
SHOULDER[1, 3] = 1.4


class Rope(Sensor):
    name, unknowns = "rope", {"length": Unknown(1.0, 0.3)}

    def prepare(self, frame, scene):
        return frame


@dataclass
class Pull(Measurement):  # what the rope tells at one time: a load cell says whether it is taut
    time: float
    taut: bool
    sensor: str = "rope"

    def match(self, scene, reach):
        return RowsOf(self.rows)

    def rows(self, scene):
        away = POST - scene.position("r_dactylion")
        beyond = np.linalg.norm(away) - scene.value("rope", "length", 1.0)
        sigma = 0.002 if self.taut or beyond > 0.0 else np.inf  # a slack rope is not felt
        return scene.along(scene.body.landmarks.select(("r_dactylion",)), away / np.linalg.norm(away), [beyond], sigma)


def simulated(arm, rig, frames, noise_px, random):  # an arm swings until the rope stops it
    seen, one = arm.keypoints("MEDIAPIPE_33"), np.ones(len(arm.keypoints("MEDIAPIPE_33")))
    for k in range(frames):
        want = np.array([1.0, -0.5, 0.0, 0.8, 0.3, 0.0, 0.0]) + 0.6 * np.sin(2 * np.pi * k / frames + np.arange(7))
        scene = Scene(arm, BodyState(SHOULDER, want), rig, values={"rope": {"length": LENGTH}})
        rows = lambda s: [Pull(0, False).rows(scene.at(s)), prior_rows(arm, s, mean=want, sigma=9)]  # noqa: B023
        state = levenberg_marquardt(arm, scene.state, rows).state
        uv = [c.project(arm.positions(state, seen)) + noise_px * random.normal(size=(len(seen), 2)) for c in rig]
        pixels = [KeypointFrame(c.name, k / 30, seen.names, p, one, "MEDIAPIPE_33") for c, p in zip(rig, uv)]
        yield state, [*pixels, Pull(k / 30, bool(Pull(0, True).rows(scene.at(state)).residual[0] > -1e-3))]


def main(frames=60, noise_px=1.0, seed=0):
    arm, rig, random = load_body("arm"), studio_rig(cameras=2), np.random.default_rng(seed)
    states, observed = zip(*simulated(arm, rig, frames, noise_px, random))
    near = [BodyState(s.T_world_root, s.angles + 0.05 * random.normal(size=7)) for s in states[::3]]
    sensors = Sensors(rig, 30.0, dict.fromkeys(rig.names, noise_px), SLOW, [Rope()])
    steps = [sensors.measurements(f, Scene(arm, s, rig)) for f, s in zip(observed[::3], near)]
    subject = fit_subject(arm, rig, steps, near, [OwnUnknowns.of([Rope()])])
    print("the rope is {:.4f} ± {:.4f} m long;".format(*subject.value("rope length")), LENGTH, "m is the truth")
    errors, hand = {}, lambda s: Scene(arm, s, rig).position("r_dactylion")
    for name, used in (("one camera", slice(0, 1)), ("one camera and the rope", slice(0, 3, 2))):
        tracker = Tracker(arm, rig, settings=SLOW, sigma=sensors.sigma, sensors=[Rope()], values=subject.values, up="y")
        tracker.start_at(states[0])
        gaps = [hand(tracker.update(f[used]).state) - hand(s) for f, s in zip(observed, states)]
        errors[name] = np.linalg.norm(gaps, axis=1)
        print(f"{name}: the hand is off by {1000 * np.median(errors[name]):.0f} mm")
    return subject, errors, np.array([f[-1].taut for f in observed])


if __name__ == "__main__":
    main()
