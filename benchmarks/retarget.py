"""A recorded walk and jumping jacks on made-up characters, resting in T and in A, with shorter and longer arms.

The files are played by numpy alone. Khronos' validator is the node package gltf-validator, found where NODE_PATH names
the `node_modules` that hold it.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from tests.exporters.skeletons.character_file import write_character_glb
from tests.exporters.skeletons.test_characters import BONES, SIDES, WORDS, play, unit

from benchmarks.figures import amount, data, figure
from kinefit.bodies.motion import Motion
from kinefit.exporters import write_character
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.simulation import retarget

RECORDINGS = ("motion_cmu_bvh/cmu_12_01_walk.bvh", "motion_animateddrawings_bvh/jumping_jacks.bvh")
CHARACTERS = ((0.0, 1.2, 1), (0.8, 0.8, 2))  # arms below the horizontal [rad], length of the arms, seed of the frames
VALIDATE = (
    "const v=require('gltf-validator'),fs=require('fs');"
    "Promise.all(process.argv.slice(1).map(f=>v.validateBytes(new Uint8Array(fs.readFileSync(f)))))"
    ".then(all=>console.log(JSON.stringify(all.map(r=>r.issues.numErrors))))"
)


def run() -> None:
    """Print the figures."""
    bones, heights, files = [], [], []
    with tempfile.TemporaryDirectory() as place:
        for name in RECORDINGS[: amount(2, 1)]:
            folder, _, file = name.partition("/")
            if (found := data(folder)) is None:
                continue
            motion = retarget(read_bvh(found / file), rate=amount(30, 5)).turned("y")
            for arms, longer, seed in CHARACTERS:
                character = Path(place) / f"character-{seed}.glb"
                files.append(Path(place) / f"{Path(file).stem}-{seed}.glb")
                write_character_glb(character, arms=arms, longer=longer, seed=seed)
                write_character(motion, character, files[-1])
                off, height = compared(files[-1], motion)
                bones.append(off)
                heights.append(height)
        if not files:
            figure("retarget_validator_errors", None, "errors", "== 0", "no recordings")
            return
        errors, why = validated(files)
    figure("retarget_validator_errors", errors, "errors", "== 0", why)
    figure("retarget_bones", max(bones), "deg, worst of arms and legs", "<= 0.01")
    figure("retarget_soles", 1000 * max(heights), "mm, worst height of the lowest point against the body's", "<= 5")


def compared(file: Path, motion: Motion) -> tuple[float, float]:
    """[deg] worst direction of a bone; [m] worst height of the mesh's lowest point, lengths of the legs made alike."""
    poses, tree, points = motion.segment_poses(), motion.body.tree, motion.body.landmarks
    parts = [tree.segment(f"{name}_{side}") for name in ("foot", "toes") for side in "lr"]
    low = motion.positions(points.select(tuple(n for n, s in zip(points.names, points.segments) if s in parts)))
    low = low[..., 1].min(axis=1)
    ground, own_leg = np.percentile(low, 5), np.linalg.norm(tree.offsets[tree.segment("shank_l")]) * 2
    worst, heights = 0.0, []
    for frame in range(0, len(motion), 5):
        nodes, skinned = play(file, frame)
        x = {name: T[:3, 3] for name, T in nodes.items()}
        for bone, far in BONES.items():
            for side, word in SIDES.items():
                mine = unit(x[word + WORDS[far]] - x[word + WORDS[bone]])
                ends = [poses[frame, tree.segment(f"{b}_{side}"), :3, 3] for b in (bone, far)]
                worst = max(worst, float(np.linalg.norm(mine - unit(ends[1] - ends[0]))))
        leg = np.linalg.norm(x["LeftLeg"] - x["LeftUpLeg"]) + np.linalg.norm(x["LeftFoot"] - x["LeftLeg"])
        heights.append(skinned[:, 1].min() - ground - leg / own_leg * (low[frame] - ground))
    return float(np.degrees(worst)), float(np.abs(heights).max())


def validated(files: list[Path]) -> tuple[float | None, str]:
    """Errors that Khronos' validator finds in all files; None, and why, where it is not there."""
    try:
        words = ["node", "-e", VALIDATE, *map(str, files)]
        told = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    except (OSError, subprocess.SubprocessError):
        return None, "npm install gltf-validator, and name its node_modules by NODE_PATH"
    return float(sum(json.loads(told.stdout))), ""


if __name__ == "__main__":
    run()
