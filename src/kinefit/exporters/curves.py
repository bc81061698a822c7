"""Coordinates of a motion over time, by OpenSim's names, each with its standard deviation: for reports and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.opensim.files import root_coordinates
from kinefit.exporters.skeletons.common import euler_zxy
from kinefit.motion import Motion


@dataclass(frozen=True, eq=False)
class Curve:
    """One coordinate over time, as OpenSim calls it: values and standard deviations (F,) in `unit`.

    `speed_std` is that of its rate of change [unit/s], NaN where the motion does not tell it. `coordinate` is its
    number in `Motion.dof_std`, None for a mixture of several.
    """

    name: str
    joint: str
    side: str  # "left", "right" or ""
    unit: str
    values: NDArray
    std: NDArray
    speed_std: float = np.nan
    coordinate: int | None = None

    @property
    def stem(self) -> str:
        """Name without the side."""
        return self.name[:-2] if self.side else self.name


def curves(motion: Motion) -> list[Curve]:
    """All coordinates: the root's as OpenSim's ground_pelvis joint has them, y up, then the angles; without jumps."""
    tree, y_up = motion.body.tree, motion.turned("y")
    names, speeds = root_coordinates(motion.body), _speeds(motion)
    turns, turns_std = _root_turns(y_up)
    out = []
    if tree.root_free:
        columns = [*turns.T, *y_up.Ts_world_root[:, :3, 3].T]
        stds = [*turns_std.T, *y_up.dof_std[:, :3].T]
        units = ["deg"] * 3 + ["m"] * 3
        turning = float(np.degrees(speeds[3:6].max()))
        fast = [turning] * 3 + [float(speeds[:3].max())] * 3
        out = [Curve(n, "pelvis", "", *of) for n, *of in zip(names, units, columns, stds, fast)]
    for d, name in enumerate(tree.coordinates):
        slides = bool(tree.prismatic[d])
        values, std, speed = motion.angles[:, d], motion.dof_std[:, 6 + d], float(speeds[6 + d])
        if not slides:
            values, std, speed = np.degrees(np.unwrap(values)), np.degrees(std), float(np.degrees(speed))
        joint, _ = split_side(motion.body.joints[tree.owners[d]])
        out.append(Curve(name, joint, split_side(name)[1], "m" if slides else "deg", values, std, speed, 6 + d))
    return out


def _speeds(motion: Motion) -> NDArray:
    """(6 + D,) [m/s, rad/s] standard deviations of rates of change, as smoothing reports them; NaN without."""
    smoothing = motion.provenance.get("smoothing")
    speed_std = smoothing.get("speed_std") if isinstance(smoothing, Mapping) else None
    speed_std = speed_std if isinstance(speed_std, Mapping) else {}
    return np.array([float(speed_std.get(name, np.nan)) for name in motion.body.dof_names])


def split_side(name: str) -> tuple[str, str]:
    """A name without its side, and "left", "right" or "": hand_l becomes ("hand", "left")."""
    side = {"_l": "left", "_r": "right"}.get(name[-2:], "")
    return (name[:-2] if side else name), side


def _root_turns(y_up: Motion) -> tuple[NDArray, NDArray]:
    """Tilt, list and rotation (F, 3) [deg] with their standard deviations, from those of a turn about the world's axes.

    R = Rz Rx Ry, so ω = z ż + Rz x ẋ + Rz Rx y ẏ; the three errors are taken as independent.
    """
    angles = euler_zxy(y_up.Ts_world_root[:, :3, :3])
    if not len(angles):
        return angles, angles
    c, s = np.cos(angles), np.sin(angles)
    J = np.zeros((len(angles), 3, 3))
    J[:, 2, 0] = 1
    J[:, 0, 1], J[:, 1, 1] = c[:, 0], s[:, 0]
    J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = -s[:, 0] * c[:, 1], c[:, 0] * c[:, 1], s[:, 1]
    known = np.isfinite(y_up.dof_std[:, 3:6]).all(axis=1) & (np.abs(c[:, 1]) > 1e-3)
    std = np.full((len(angles), 3), np.inf)
    std[known] = np.sqrt((np.linalg.inv(J[known]) ** 2 @ y_up.dof_std[known, 3:6, None] ** 2)[..., 0])
    return np.degrees(np.unwrap(angles, axis=0)), np.degrees(std)


DIGITS = {"thumb": "Thumb"} | {digit: f"{digit.capitalize()} finger" for digit in ("index", "middle", "ring", "little")}
"""Digits of a hand, as coordinates and segments begin, in words."""

FINGER_JOINTS = ("cmc", "mcp", "pip", "dip", "ip")
_FINGER_MOVES = {"flex": "flexion", "abd": "abduction", "dev": "ulnar deviation"}

NAMES = {
    "hip_flexion": "Hip flexion", "hip_adduction": "Hip adduction", "hip_rotation": "Hip inward rotation",
    "knee_angle": "Knee flexion", "ankle_angle": "Ankle dorsiflexion", "subtalar_angle": "Subtalar inversion",
    "mtp_angle": "Toe extension", "clav_prot": "Shoulder girdle protraction", "clav_elev": "Shoulder girdle elevation",
    "arm_flex": "Shoulder flexion", "arm_add": "Shoulder adduction", "arm_rot": "Shoulder inward rotation",
    "elbow_flex": "Elbow flexion", "pro_sup": "Forearm pronation", "wrist_flex": "Wrist flexion",
    "wrist_dev": "Wrist ulnar deviation", "pelvis_tilt": "Pelvic tilt (backward)",
    "pelvis_list": "Pelvic obliquity (right down)", "pelvis_rotation": "Pelvic rotation (to the left)",
    "lumbar_extension": "Lumbar extension", "lumbar_bending": "Lumbar bending (to the right)",
    "lumbar_rotation": "Lumbar rotation (to the left)", "thorax_extension": "Thoracic extension",
    "thorax_bending": "Thoracic bending (to the right)", "thorax_rotation": "Thoracic rotation (to the left)",
    "neck_extension": "Neck extension", "neck_bending": "Neck bending (to the right)",
    "neck_rotation": "Neck rotation (to the left)",
    **{f"{digit}_{joint}_{move}": f"{digit.capitalize()} {joint.upper()} {of}"
       for digit in DIGITS for joint in FINGER_JOINTS for move, of in _FINGER_MOVES.items()},
}  # fmt: skip
"""Clinical names of OpenSim's coordinates, in the direction that counts as positive."""


def spoken(coordinate: str) -> str:
    """Clinical name of a coordinate, with its side in words: hip_flexion_l becomes "left hip flexion"."""
    stem, side = split_side(coordinate)
    name = NAMES.get(stem, stem.replace("_", " "))
    return f"{side} {name[0].lower()}{name[1:]}".strip()
