"""Track a take from Python: joint angles with their error bars.

    python examples/00_demo_track.py                    the sample recording (fetched once, 51 MB)
    python examples/00_demo_track.py my_take/take.toml  your own
"""

import sys

import numpy as np

import kinefit

COORDINATES = ("hip_flexion_r", "knee_angle_r", "hip_flexion_l", "knee_angle_l", "arm_flex_r", "elbow_flex_r")


def main(take_file=None, out="kinefit-example"):
    motion, _ = kinefit.track_take(take_file or kinefit.readers.assets.write_sample_take(f"{out}/take"))

    print(f"{motion.name}: {len(motion)} frames at {motion.rate:g} Hz, quality {motion.quality.mean():.2f}")
    for camera, residuals in motion.residuals.items():
        median, swaps = np.nanmedian(residuals.norms), residuals.swapped.sum()
        print(f"  {camera}: median residual {median:.1f} px, left/right put right in {swaps} frames")

    # angles (F, D) are in radians and named by the tree; dof_std has the root's six degrees of freedom in front.
    print("angles [deg] with one standard deviation:")
    for frame in np.linspace(0, len(motion) - 1, 5).astype(int):
        told = []
        for name in COORDINATES:
            d = motion.body.tree.coordinate(name)
            angle, std = np.degrees([motion.angles[frame, d], motion.dof_std[frame, 6 + d]])
            told.append(f"{name} {angle:6.1f} ±{std:4.1f}")
        print(f"  {motion.times[frame]:5.2f} s  " + "  ".join(told))

    # Joint centres in the world: one pose (4, 4) for every frame and segment.
    knee = motion.segment_poses()[:, motion.body.tree.segment("shank_r"), :3, 3]
    print(f"the right knee moved within {np.ptp(knee, axis=0).round(2)} m (x, y, z; {motion.up} is up)")

    kinefit.exporters.write_bvh(motion, f"{out}/motion.bvh")
    kinefit.exporters.write_csv(motion, f"{out}/tables")
    print(f"written: {out}/motion.bvh, {out}/tables")
    return motion


if __name__ == "__main__":
    main(*sys.argv[1:])
