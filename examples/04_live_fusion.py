"""A live source: depth images and keypoints, frame by frame, as a camera's loop would hand them over.

Here both are simulated from a wave of the hand, with a first Kinect's errors, so that the truth is known.

    python examples/04_live_fusion.py
"""

import numpy as np

from kinefit import Tracker
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, KeypointFrame
from kinefit.simulation import KINECT, in_front, movement, people, simulate_depth

JOINTS = ("l_wrist", "r_wrist", "l_elbow", "r_elbow", "neck", "l_knee", "r_knee")


def main(frames=30, seed=0):
    """Returns the joints' mean error [m] and the tracker."""
    person = people(seed=seed)[2]
    truth = movement("wave", person.body, rate=15.0)
    camera = in_front(truth, KINECT.camera(name="kinect"), near=KINECT.near, far=KINECT.far)
    video = simulate_depth(truth, camera, KINECT, seed=seed)
    points = person.body.landmarks.select(JOINTS)
    rng = np.random.default_rng(seed)

    tracker = Tracker(person.body, Rig((camera,)), rate=15.0, sigma={"kinect": 0.008}, up="y")
    tracker.start_at(truth.state(0))  # left out, the tracker finds its start in the first image
    errors = []
    for i in range(min(frames, len(truth))):
        uv = camera.project(truth.positions(points)[i]) + 2.0 * rng.standard_normal((len(JOINTS), 2))
        seen = [
            DepthFrame("kinect", truth.times[i], video.frame(i).depth),
            KeypointFrame("kinect", truth.times[i], JOINTS, uv, np.full(len(JOINTS), 0.9)),
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
