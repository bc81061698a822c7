"""Convert recorded skeletons of several families to common joints and bone directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.joint_names import SIDES, Recorded, recorded_joints
from kinefit.errors import ObservationError
from kinefit.motion import rotation_between_up
from kinefit.observations import SkeletonMotion

_MIN_BONE_LENGTH = 0.005  # [m]: a shorter bone has no direction


@dataclass(frozen=True, eq=False)
class BoneDirections:
    """Bone directions of a recorded motion, y up; all arrays (F, 3), unit vectors or NaN.

    Parameters
    ----------
    rate : float [Hz]
    hip_centre : (F, 3) [m]
    leg_length : float [m] of thigh and shank
    bones : name -> direction
        "pelvis" (hip centre to sacrum), "abdomen", "thorax", "head" (from the root of the neck to the top of the head,
        or between the eyes), and with _l and _r "thigh", "shank", "foot", "toes", "clavicle" (from the root of the neck
        to the shoulder), "upperarm", "forearm", "hand".
    across : name -> direction
        From left to right across "pelvis", "thorax" and "head"; towards the thumb across "hand_l" and "hand_r".
    upright : name -> (2,) forward and up, unit
        Directions of "pelvis", "abdomen", "thorax" and "head" of an upright person: skeletons differ in the places of
        the spine's joints.
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
        """The bone directions at another rate [Hz], interpolated linearly."""
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
    """(N,) positions of the frames at a new rate [Hz] among the old ones (0 .. frames - 1) at `rate` [Hz].

    Raises
    ------
    ObservationError
        The new rate is not positive.
    """
    if not 0 < new_rate < np.inf:
        raise ObservationError(f"the rate {new_rate} is not positive", remedy="Give frames per second.")
    return np.arange(int((frames - 1) / rate * new_rate + 1e-6) + 1) * (rate / new_rate)


def bone_directions(skeleton: SkeletonMotion, names: Mapping[str, str] | None = None) -> BoneDirections:
    """Directions of the bones of a recorded skeleton.

    Parameters
    ----------
    skeleton : SkeletonMotion
    names : segment -> name of a joint, optional
        See `bodies.joint_names.recorded_joints`; default: the skeleton's family is found by its joint names.

    Raises
    ------
    ObservationError
        The skeleton is of no known family; a bone of the trunk, the arms or the legs has no length.
    """
    found = recorded_joints(skeleton.names, names, source=skeleton.source)
    joints, R_up = found.joints, rotation_between_up(skeleton.up, "y")
    positions = skeleton.positions @ R_up.T
    rest, right, forward = _rest(skeleton, found, R_up)

    def turned(role: str, direction: NDArray) -> NDArray:  # direction in the rest pose -> (F, 3) with the joint
        return (R_up @ skeleton.Ts_world_joint[:, joints[role], :3, :3] @ R_up.T) @ direction

    def end(role: str, of: str) -> NDArray:  # the first child of `of` if there is no joint of this name
        return positions[:, joints.get(role, _child(skeleton, joints[of]))]

    joint = {role: positions[:, index] for role, index in joints.items()}
    neck = joint["neck"]
    hip_centre = 0.5 * (joint["thigh_l"] + joint["thigh_r"])
    bones = {"pelvis": joint["sacrum"] - hip_centre, "abdomen": joint["spine"] - joint["sacrum"]}
    bones["thorax"] = neck - joint["spine"]
    across = {
        "pelvis": joint["thigh_r"] - joint["thigh_l"], "thorax": joint["upperarm_r"] - joint["upperarm_l"],
    }  # fmt: skip
    if "eye_l" in joints:
        bones["head"] = 0.5 * (joint["eye_l"] + joint["eye_r"]) - neck
        across["head"] = joint["eye_r"] - joint["eye_l"]
    else:
        bones["head"], across["head"] = end("head_top", "head") - neck, turned("head", right)
    for s in SIDES:
        chain = {
            "thigh": "shank", "shank": "foot", "foot": "toes", "upperarm": "forearm", "forearm": "hand",
        }  # fmt: skip
        bones |= {f"{bone}_{s}": joint[f"{far}_{s}"] - joint[f"{bone}_{s}"] for bone, far in chain.items()}
        bones[f"toes_{s}"] = end(f"toe_end_{s}", f"toes_{s}") - joint[f"toes_{s}"]
        bones[f"clavicle_{s}"] = joint[f"upperarm_{s}"] - neck
        bones[f"hand_{s}"] = end(f"knuckle_{s}", f"hand_{s}") - joint[f"hand_{s}"]
        palm = f"palm_{s}" if f"palm_{s}" in joints else f"hand_{s}"
        thumb = joint.get(f"thumb_{s}")
        across[f"hand_{s}"] = turned(palm, forward) if thumb is None else thumb - joint[palm]
    legs = [np.linalg.norm(bones[f"{bone}_{side}"], axis=1).mean() for bone in ("thigh", "shank") for side in SIDES]
    for name, vector in bones.items():
        if not name.startswith(("hand", "toes")) and np.any(np.linalg.norm(vector, axis=1) < _MIN_BONE_LENGTH):
            raise ObservationError(f"the bone '{name}' has no length", file=skeleton.source or None)
    return BoneDirections(
        skeleton.rate, hip_centre, float(sum(legs) / 2),
        {name: _unit(v) for name, v in bones.items()}, {name: _unit(v) for name, v in across.items()},
        _upright(skeleton, found, rest, forward),
    )


def _child(skeleton: SkeletonMotion, joint: int) -> int:
    """The first child of a joint; the joint itself if it has none, so that the bone has no direction."""
    children = np.flatnonzero(skeleton.parents == joint)
    return int(children[0]) if len(children) else joint


def _rest(skeleton: SkeletonMotion, found: Recorded, R_up: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Joints (J, 3) of the rest pose, y up, and the directions (3,) to the right and forward in it."""
    rest = skeleton.rest @ R_up.T
    across = _unit(rest[found.joints["thigh_r"]] - rest[found.joints["thigh_l"]])
    return rest, across, _unit(np.cross([0.0, 1.0, 0.0], across))


def _upright(skeleton: SkeletonMotion, found: Recorded, rest: NDArray, forward: NDArray) -> dict[str, NDArray]:
    vectors = np.array(found.upright)
    if found.upright is None:
        joints = found.joints
        hips = rest[[joints["thigh_l"], joints["thigh_r"]]].mean(axis=0)
        top = joints.get("head_top", _child(skeleton, joints["head"]))
        bones = np.diff([hips, *rest[[joints["sacrum"], joints["spine"], joints["neck"], top]]], axis=0)
        vectors = np.stack([bones @ forward, bones[:, 1]], axis=1)
    return dict(zip(("pelvis", "abdomen", "thorax", "head"), _unit(vectors)))


def _unit(vectors: NDArray) -> NDArray:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(norms >= _MIN_BONE_LENGTH, vectors / np.where(norms > 0, norms, 1.0), np.nan)
