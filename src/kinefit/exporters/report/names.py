"""What a clinician calls the coordinates of a body."""

from __future__ import annotations

from kinefit.exporters.curves import split_side

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
