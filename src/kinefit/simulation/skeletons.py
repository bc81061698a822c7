"""Recorded skeletons of several families, told as the same few joints and directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.motion import rotation_between_up
from kinefit.observations import SkeletonMotion

_SIDES = {"l": {"s": "l", "S": "L", "Side": "Left"}, "r": {"s": "r", "S": "R", "Side": "Right"}}
_LIMBS = ("hip", "knee", "ankle", "toe", "shoulder", "elbow", "wrist", "knuckle")
_LEAST_BONE = 0.005  # [m] a shorter bone has no direction


@dataclass(frozen=True)
class Family:
    """Joint names of one family of skeletons.

    Parameters
    ----------
    name : str
    spine : names of the joints at the sacrum, a third of the way up the spine, at the root of the neck, in the head.
    limbs : names of hip, knee, ankle, ball of the foot, shoulder, elbow, wrist, knuckles; {s}, {S}, {Side}
        are l, L, Left.
    toe_end : name of the tip of the toes.
    hand : names of the joint whose frame turns with the hand (at rest the thumbs are in front), or of two joints, the
        second one on the thumb's side.
    head_top : name of the top of the head; None where the eyes tell how the head is turned.
    eyes : name of the eyes, or None.
    upright : (forward, up) of the bones "pelvis", "abdomen", "thorax", "head" (see `BoneDirections`) of a person who
        stands upright; None where the rest pose of the file is that.
    """

    name: str
    spine: tuple[str, str, str, str]
    limbs: tuple[str, ...]
    toe_end: str
    hand: tuple[str, ...]
    head_top: str | None = None
    eyes: str | None = None
    upright: tuple[tuple[float, float], ...] | None = None

    @property
    def joints(self) -> tuple[str, ...]:
        """All joints that the family is recognised by."""
        both = [name.format(**side) for side in _SIDES.values() for name in (*self.limbs, self.toe_end, *self.hand)]
        eyes = [self.eyes.format(**side) for side in _SIDES.values()] if self.eyes else []
        return tuple(dict.fromkeys([*self.spine, *([self.head_top] if self.head_top else []), *both, *eyes]))


FAMILIES = (
    Family(
        "Acclaim (CMU)", ("root", "upperback", "lowerneck", "head"),
        ("{s}femur", "{s}tibia", "{s}foot", "{s}toes", "{s}humerus", "{s}radius", "{s}wrist", "{s}fingers"),
        "{s}toes_end", ("{s}hand",), "head_end",
    ),
    Family(
        "MotionBuilder (CMU)", ("Hips", "Spine", "Neck", "Head"),
        ("{Side}UpLeg", "{Side}Leg", "{Side}Foot", "{Side}ToeBase", "{Side}Arm", "{Side}ForeArm", "{Side}Hand",
         "{Side}HandIndex1"),
        "{Side}ToeBase_end", ("{Side}FingerBase",), "Head_end",
    ),
    Family(
        "hip and knee (CMU)", ("Hips", "Chest", "lowerneck", "Head"),
        ("{Side}Hip", "{Side}Knee", "{Side}Ankle", "{Side}Toe", "{Side}Shoulder", "{Side}Elbow", "{Side}Wrist",
         "{S}Fingers"),
        "{Side}Toe_end", ("{s}hand",), "Head_end",
    ),
    Family(
        "AnimatedDrawings", ("Hips", "Spine1", "Neck", "Head"),
        ("{Side}UpLeg", "{Side}Leg", "{Side}Foot", "{Side}ToeBase", "{Side}Arm", "{Side}ForeArm", "{Side}Hand",
         "{Side}HandEnd"),
        "{Side}ToeBase_end", ("{Side}Hand",), "Head_end",
    ),
    Family(
        "iClone", ("CC_Base_Waist", "CC_Base_Spine01", "CC_Base_NeckTwist01", "CC_Base_Head"),
        ("CC_Base_{S}_Thigh", "CC_Base_{S}_Calf", "CC_Base_{S}_Foot", "CC_Base_{S}_ToeBase", "CC_Base_{S}_Upperarm",
         "CC_Base_{S}_Forearm", "CC_Base_{S}_Hand", "CC_Base_{S}_Mid1"),
        "CC_Base_{S}_MidToe1", ("CC_Base_{S}_Pinky1", "CC_Base_{S}_Index1"), eyes="CC_Base_{S}_Eye",
        upright=((0.17, 0.985), (0.588, 0.809), (-0.19, 0.982), (0.543, 0.84)),
    ),
)


@dataclass(frozen=True, eq=False)
class BoneDirections:
    """A recorded motion without its lengths, y up; all arrays (F, 3), directions of unit length or NaN.

    Parameters
    ----------
    rate : float [Hz]
    hip_centre : (F, 3) [m]
    leg_length : float [m] of thigh and shank.
    bones : name -> direction
        "pelvis" (hip centre to sacrum), "abdomen", "thorax", "head" (from the root of the neck to the top of the head,
        or between the eyes), and with _l and _r "thigh", "shank", "foot", "toes", "clavicle" (from the root of the neck
        to the shoulder), "upperarm", "forearm", "hand".
    across : name -> direction
        From left to right across "pelvis", "thorax" and "head"; towards the thumb across "hand_l" and "hand_r".
    upright : name -> (2,) forward and up, unit
        Directions of "pelvis", "abdomen", "thorax" and "head" when the person stands upright: skeletons differ in where
        they put the joints of the spine.
    """

    rate: float
    hip_centre: NDArray
    leg_length: float
    bones: Mapping[str, NDArray]
    across: Mapping[str, NDArray]
    upright: Mapping[str, NDArray]

    def __len__(self) -> int:
        return len(self.hip_centre)

    def resampled(self, rate: float) -> BoneDirections:
        """The same at another rate [Hz], linearly between frames."""
        at = steps(len(self), self.rate, rate)
        low = np.minimum(at.astype(int), len(self) - 1)
        high, share = np.minimum(low + 1, len(self) - 1), (at - low)[:, None]

        def between(array: NDArray) -> NDArray:
            return (1 - share) * array[low] + share * array[high]

        return BoneDirections(
            rate, between(self.hip_centre), self.leg_length,
            {name: _unit(between(v)) for name, v in self.bones.items()},
            {name: _unit(between(v)) for name, v in self.across.items()}, self.upright,
        )


def steps(frames: int, rate: float, new_rate: float) -> NDArray:
    """Where the frames at a new rate [Hz] lie among the old ones (0 .. frames - 1).

    Raises
    ------
    ObservationError
        The new rate is not positive.
    """
    if not 0 < new_rate < np.inf:
        raise ObservationError(f"the rate {new_rate} is not positive", remedy="Give frames a second.")
    return np.arange(int((frames - 1) / rate * new_rate + 1e-6) + 1) * (rate / new_rate)


def family_of(skeleton: SkeletonMotion) -> Family:
    """The family of a skeleton by the names of its joints.

    Raises
    ------
    ObservationError
        None fits; the message tells what lacks for the nearest one.
    """
    lacking = {family: [name for name in family.joints if name not in skeleton.names] for family in FAMILIES}
    family = min(FAMILIES, key=lambda family: len(lacking[family]) / len(family.joints))
    if lacking[family]:
        names = ", ".join(family.name for family in FAMILIES)
        raise ObservationError(
            f"the skeleton is of no known family ({names}); for '{family.name}' it lacks: {', '.join(lacking[family])}",
            file=skeleton.source or None, remedy="Rename its joints to those of a known family.",
        )
    return family


def bone_directions(skeleton: SkeletonMotion) -> BoneDirections:
    """Directions of the bones of a recorded skeleton of a known family.

    Raises
    ------
    ObservationError
        Of no known family, or a bone of the trunk, the arms or the legs has no length.
    """
    family = family_of(skeleton)
    R_up = rotation_between_up(skeleton.up, "y")
    positions = skeleton.positions @ R_up.T
    rest, right, forward = _rest(skeleton, family, R_up)

    def index(name: str, side: str) -> int:
        return skeleton.names.index(name.format(**_SIDES[side]))

    def at(name: str, side: str = "l") -> NDArray:
        return positions[:, index(name, side)]

    def turned(name: str, direction: NDArray, side: str = "l") -> NDArray:  # with the joint, from the rest pose
        return (R_up @ skeleton.Ts_world_joint[:, index(name, side), :3, :3] @ R_up.T) @ direction

    joint = {f"{limb}_{side}": at(name, side) for side in _SIDES for limb, name in zip(_LIMBS, family.limbs)}
    sacrum, spine, neck = (at(name) for name in family.spine[:3])
    hip_centre = 0.5 * (joint["hip_l"] + joint["hip_r"])
    bones = {"pelvis": sacrum - hip_centre, "abdomen": spine - sacrum, "thorax": neck - spine}
    across = {"pelvis": joint["hip_r"] - joint["hip_l"], "thorax": joint["shoulder_r"] - joint["shoulder_l"]}
    if family.eyes:
        left_eye, right_eye = at(family.eyes, "l"), at(family.eyes, "r")
        bones["head"], across["head"] = 0.5 * (left_eye + right_eye) - neck, right_eye - left_eye
    else:
        bones["head"], across["head"] = at(family.head_top or "") - neck, turned(family.spine[3], right)
    for side in _SIDES:
        chain = [joint[f"{limb}_{side}"] for limb in _LIMBS]
        for name, (start, end) in {
            "thigh": chain[0:2], "shank": chain[1:3], "foot": chain[2:4],
            "toes": (chain[3], at(family.toe_end, side)), "clavicle": (neck, chain[4]),
            "upperarm": chain[4:6], "forearm": chain[5:7], "hand": chain[6:8],
        }.items():
            bones[f"{name}_{side}"] = end - start
        hand = [at(name, side) for name in family.hand]
        across[f"hand_{side}"] = hand[1] - hand[0] if len(hand) == 2 else turned(family.hand[0], forward, side)
    legs = [np.linalg.norm(bones[f"{bone}_{side}"], axis=1).mean() for bone in ("thigh", "shank") for side in _SIDES]
    for name, vector in bones.items():
        if not name.startswith(("hand", "toes")) and np.any(np.linalg.norm(vector, axis=1) < _LEAST_BONE):
            raise ObservationError(f"the bone '{name}' has no length", file=skeleton.source or None)
    return BoneDirections(
        skeleton.rate, hip_centre, float(sum(legs) / 2),
        {name: _unit(v) for name, v in bones.items()}, {name: _unit(v) for name, v in across.items()},
        _upright(skeleton, family, rest, forward),
    )


def _rest(skeleton: SkeletonMotion, family: Family, R_up: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Joints (J, 3) of the rest pose, y up, and the directions (3,) to the right and forward in it."""
    rest = np.array(skeleton.offsets)
    for joint, parent in enumerate(skeleton.parents):
        rest[joint] += rest[parent] if parent >= 0 else 0.0
    rest = rest @ R_up.T
    left, right = (rest[skeleton.names.index(family.limbs[0].format(**side))] for side in _SIDES.values())
    across = _unit(right - left)
    return rest, across, _unit(np.cross([0.0, 1.0, 0.0], across))


def _upright(skeleton: SkeletonMotion, family: Family, rest: NDArray, forward: NDArray) -> dict[str, NDArray]:
    vectors = np.array(family.upright)
    if family.upright is None:
        hips = [skeleton.names.index(family.limbs[0].format(**side)) for side in _SIDES.values()]
        spine = [skeleton.names.index(name or "") for name in (*family.spine[:3], family.head_top)]
        bones = np.diff([rest[hips].mean(axis=0), *rest[spine]], axis=0)
        vectors = np.stack([bones @ forward, bones[:, 1]], axis=1)
    return dict(zip(("pelvis", "abdomen", "thorax", "head"), _unit(vectors)))


def _unit(vectors: NDArray) -> NDArray:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(norms >= _LEAST_BONE, vectors / np.where(norms > 0, norms, 1.0), np.nan)
