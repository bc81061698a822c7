"""A recorded motion, as four cameras would have seen it, tracked, and compared with the truth.

    python examples/03_known_motion.py             a drawn exercise
    python examples/03_known_motion.py walk.bvh    a motion of your own
"""

import sys

import numpy as np

import kinefit
from kinefit import simulation
from kinefit.simulation import evaluation


def main(bvh=None, frames=60, noise_px=3.0):
    truth = simulation.retarget(kinefit.readers.read_bvh(bvh), rate=30.0) if bvh else simulation.squat_and_wave()
    truth = simulation.cut(truth, 0, frames)
    rig = simulation.studio_rig(truth, cameras=4)
    seen = simulation.simulate_keypoints(truth, rig, "MEDIAPIPE_33", noise_px=noise_px, outliers=0.1, missing=0.1)
    print(f"{truth.name}: {len(truth)} frames, {len(rig)} cameras, {noise_px:g} px noise, 10 % outliers, 10 % missing")

    # The generic body goes in: the person's lengths are found from the keypoints alone.
    recording = kinefit.Recording.of_keypoints(rig, seen, sigma=noise_px, up=truth.up)
    result = kinefit.track(recording, kinefit.load_body("humanoid"))

    joints = 1000 * evaluation.joint_errors(truth, result)  # [mm]
    angles = np.abs(evaluation.angle_errors(truth, result))  # [deg]
    within = evaluation.coverage(truth, result, sigmas=2.0)
    print(f"joint centres: off by {joints.mean():.1f} mm on average, {np.percentile(joints, 95):.1f} mm at 95 %")
    print(f"angles: off by {angles.mean():.1f} deg on average, {np.median(angles):.1f} deg in the median")
    print(f"within two standard deviations: {within.joints:.0%} of joint centres, {within.angles:.0%} of angles")
    worst = np.argsort(-joints.mean(axis=0))[:3]
    print("worst: " + ", ".join(f"{truth.body.tree.segments[s]} {joints[:, s].mean():.1f} mm" for s in worst))
    return joints, angles


if __name__ == "__main__":
    main(*sys.argv[1:])
