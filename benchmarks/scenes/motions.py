"""Twenty recorded motions on the humanoid: walking, running, jumping, waving, bending, dancing."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.figures import amount, data, quick
from kinefit import Motion
from kinefit.readers import read_amc, read_bvh
from kinefit.simulation import cut, resampled, retarget

RATE = 60.0

# name: (folder, file, ASF or None, first and last second); two takes hold several movements and are cut in parts
MOTIONS: dict[str, tuple[str, str, str | None, float, float | None]] = {
    "walk 02_01": ("motion_cmu_amc", "02_01.amc", "02.asf", 0, None),
    "run 02_03": ("motion_cmu_amc", "02_03.amc", "02.asf", 0, None),
    "jump 02_04": ("motion_cmu_amc", "02_04.amc", "02.asf", 0, None),
    "bend 02_06": ("motion_cmu_amc", "02_06.amc", "02.asf", 0, 9),
    "lift 02_06": ("motion_cmu_amc", "02_06.amc", "02.asf", 9, None),
    "wash 02_10": ("motion_cmu_amc", "02_10.amc", "02.asf", 0, 10),
    "uneven walk 03_01": ("motion_cmu_amc", "03_01.amc", "03.asf", 0, None),
    "jumping jacks 13_30": ("motion_cmu_amc", "13_30.amc", "02.asf", 0, 6),
    "twists and squats 13_30": ("motion_cmu_amc", "13_30.amc", "02.asf", 6, 14),
    "jog 13_30": ("motion_cmu_amc", "13_30.amc", "02.asf", 14, None),
    "reach 14_20": ("motion_cmu_amc", "14_20.amc", "02.asf", 12, 22),
    "bend over 14_20": ("motion_cmu_amc", "14_20.amc", "02.asf", 26, 36),
    "walk 12_01": ("motion_cmu_bvh", "cmu_12_01_walk.bvh", None, 0.05, None),
    "slow walk 007_04": ("motion_cmu_bvh", "007_04.bvh", None, 0.05, None),
    "brisk walk 007_12": ("motion_cmu_bvh", "007_12.bvh", None, 0.05, None),
    "walk 002_01": ("motion_cmu_bvh", "002_01.bvh", None, 0, None),
    "jump 002_04": ("motion_cmu_bvh", "002_04.bvh", None, 0, None),
    "wave": ("motion_animateddrawings_bvh", "wave_hello.bvh", None, 0, None),
    "jumping": ("motion_animateddrawings_bvh", "jumping.bvh", None, 0, None),
    "zombie walk": ("motion_animateddrawings_bvh", "zombie.bvh", None, 0, 10),
}

QUICK, LONGEST = ("walk 02_01",), amount(None, 90)
"""The motion of the quick form, and how many frames of it."""


def library(names: list[str] | None = None) -> dict[str, Motion]:
    """The motions at 60 Hz (or their own rate where lower); those whose recording is absent are left out."""
    whole: dict[tuple[str, str], Motion] = {}
    out = {}
    chosen = names or (QUICK if quick() else MOTIONS)
    for name in chosen:
        folder, file, asf, start, stop = MOTIONS[name]
        root = data(folder)
        if root is None or not (root / file).exists():
            continue
        if (folder, file) not in whole:
            skeleton = read_amc(root / asf, root / file) if asf else read_bvh(root / file)
            if LONGEST is not None:
                until = max(MOTIONS[n][3] for n in chosen if MOTIONS[n][:2] == (folder, file)) + (LONGEST + 2) / RATE
                skeleton = replace(skeleton, Ts_world_joint=skeleton.Ts_world_joint[: round(until * skeleton.rate)])
            motion = retarget(skeleton)
            whole[folder, file] = resampled(motion, RATE) if motion.rate > RATE else motion
        motion = whole[folder, file]
        first = round(start * motion.rate)
        last = len(motion) if stop is None else min(len(motion), round(stop * motion.rate))
        out[name] = cut(motion, first, last if LONGEST is None else min(last, first + LONGEST))
    return out
