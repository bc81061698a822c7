"""A sensor of one's own: a rope from a hand to a post, which pulls and never pushes, and whose length is not known.

Two cameras and the rope find its length. One camera, which cannot see how far away a hand is, and the rope then track.
    python examples/07_own_sensor.py
"""

from dataclasses import dataclass

import numpy as np

import kinefit
from kinefit.observations import KeypointFrame
from kinefit.sensors import Scene, Unknown

POST, LENGTH, RATE = np.array([0.9, 1.7, 0.9]), 0.8, 30.0
SETTINGS = kinefit.TrackSettings(angle_acceleration=60.0)
SHOULDER = np.eye(4)
SHOULDER[1, 3] = 1.4


class Rope(kinefit.Sensor):
    name, unknowns = "rope", {"length": Unknown(1.0, 0.3)}

    def prepare(self, frame, scene):
        return frame


@dataclass
class Pull(kinefit.Measurement):  # what the rope measures at one time: a load cell says whether it is taut
    time: float
    taut: bool
    sensor: str = "rope"

    def match(self, scene, reach):
        return kinefit.RowsOf(self.rows)

    def rows(self, scene):
        away = POST - scene.position("r_dactylion")
        beyond = np.linalg.norm(away) - scene.value("rope", "length", 1.0)
        sigma = 0.002 if self.taut or beyond > 0.0 else np.inf  # a slack rope is not felt
        return scene.along(scene.body.landmarks.select(("r_dactylion",)), away / np.linalg.norm(away), [beyond], sigma)


def simulated(arm, rig, frames, noise_px, random):
    """Yield state and frames of all sensors: an arm swings until the rope stops it."""
    points = arm.keypoints("MEDIAPIPE_33")
    for k in range(frames):
        mean = np.array([1.0, -0.5, 0.0, 0.8, 0.3, 0.0, 0.0]) + 0.6 * np.sin(2 * np.pi * k / frames + np.arange(7))
        scene = Scene(arm, kinefit.BodyState(SHOULDER, mean), rig, values={"rope": {"length": LENGTH}})
        prior = lambda state, mean=mean: kinefit.solving.correspondences.prior_rows(arm, state, mean=mean, sigma=9)
        rows = lambda state, scene=scene: [Pull(0, False).rows(scene.at(state)), prior(state)]  # noqa: B023
        state = kinefit.solving.levenberg_marquardt(arm, scene.state, rows).state
        taut = bool(Pull(0, True).rows(scene.at(state)).residual[0] > -1e-3)
        uv = [c.project(arm.positions(state, points)) + noise_px * random.normal(size=(len(points), 2)) for c in rig]
        frame = lambda c, p: KeypointFrame(c.name, k / RATE, points.names, p, np.ones(len(p)), "MEDIAPIPE_33")  # noqa: B023
        yield state, [*map(frame, rig, uv), Pull(k / RATE, taut)]


def main(frames=60, noise_px=1.0, seed=0):
    arm, rig, random = kinefit.load_body("arm"), kinefit.simulation.studio_rig(cameras=2), np.random.default_rng(seed)
    states, steps = zip(*simulated(arm, rig, frames, noise_px, random))
    options = {"rate": RATE, "sigma": dict.fromkeys(rig.names, noise_px), "settings": SETTINGS, "up": "y"}
    near = [kinefit.BodyState(s.T_world_root, s.angles + 0.05 * random.normal(size=7)) for s in states[::3]]
    sensors = kinefit.Tracker(arm, rig, sensors=[Rope()], **options).sensors
    seen = [sensors.measurements(f, Scene(arm, s, rig)) for f, s in zip(steps[::3], near)]
    subject = kinefit.fitting.fit_subject(arm, rig, seen, near, [kinefit.fitting.OwnUnknowns.of([Rope()])])
    print("the rope is {:.4f} ± {:.4f} m long;".format(*subject.value("rope length")), LENGTH, "m is the truth")
    errors, hand = {}, lambda s: Scene(arm, s, rig).position("r_dactylion")
    for name, used in (("one camera", slice(0, 1)), ("one camera and the rope", slice(0, 3, 2))):
        tracker = kinefit.Tracker(arm, rig, values=subject.values, sensors=[Rope()], **options)
        tracker.start_at(states[0])
        gaps = [hand(tracker.update(f[used]).state) - hand(s) for f, s in zip(steps, states)]
        errors[name] = np.linalg.norm(gaps, axis=1)
        print(f"{name}: the hand is off by {1000 * np.median(errors[name]):.0f} mm")
    return subject, errors, np.array([f[-1].taut for f in steps])


if __name__ == "__main__":
    main()
