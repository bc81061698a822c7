"""A live source: depth images and keypoints, frame by frame, as a camera's loop would hand them over.

Here both are simulated from a wave of the hand, with a first Kinect's errors, so that the truth is known.

    python examples/04_live_fusion.py
"""

import numpy as np

import kinefit
from kinefit import simulation

JOINTS = ("l_wrist", "r_wrist", "l_elbow", "r_elbow", "neck", "l_knee", "r_knee")


def main(frames=30, seed=0):
    """Returns the joints' mean error [m] and the tracker."""
    person = simulation.people(seed=seed)[2]
    truth = simulation.movement("wave", person.body, rate=15.0)
    kinect = simulation.KINECT
    camera = simulation.in_front(truth, kinect.camera(name="kinect"), near=kinect.near, far=kinect.far)
    video = simulation.simulate_depth(truth, camera, kinect, seed=seed)
    points = person.body.landmarks.select(JOINTS)
    rng = np.random.default_rng(seed)

    rig = kinefit.Rig((camera,))
    tracker = kinefit.Tracker(person.body, rig, rate=15.0, sigma={"kinect": 0.008}, up="y")
    tracker.start_at(truth.state(0))  # left out, the tracker finds its start in the first image
    errors = []
    for i in range(min(frames, len(truth))):
        uv = camera.project(truth.positions(points)[i]) + 2.0 * rng.standard_normal((len(JOINTS), 2))
        seen = [
            kinefit.observations.DepthFrame("kinect", truth.times[i], video.frame(i).depth),
            kinefit.observations.KeypointFrame("kinect", truth.times[i], JOINTS, uv, np.full(len(JOINTS), 0.9)),
        ]
        result = tracker.update(seen)
        x = person.body.positions(result.state, points)
        errors.append(np.linalg.norm(x - truth.positions(points)[i], axis=1).mean())
        lost = [person.body.tree.segments[s] for s in np.flatnonzero(result.lost)]
        error = 1e3 * errors[-1]
        print(f"{result.time:5.2f} s  quality {result.quality:.2f}  error {error:4.1f} mm  lost: {lost or None}")
    return float(np.mean(errors)), tracker


if __name__ == "__main__":
    print(f"mean error {1e3 * main()[0]:.1f} mm")
