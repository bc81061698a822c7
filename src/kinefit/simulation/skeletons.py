"""Convert recorded skeletons of several families to common joints and bone directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import rotation_between_up
from kinefit.bodies.toml.joint_names import SIDES, Recorded, recorded_joints
from kinefit.errors import ObservationError
from kinefit.findings import Finding
from kinefit.geometry import se3
from kinefit.observations import SkeletonMotion

_MIN_BONE_LENGTH = 0.005  # [m]: a shorter bone has no direction
_NEXT_BONE = {"thigh": "shank", "shank": "foot", "foot": "toes", "upperarm": "forearm", "forearm": "hand"}
_CHAINS = tuple((f"{bone}_{s}", f"{far}_{s}") for bone, far in _NEXT_BONE.items() for s in SIDES)
_MAX_REST_DEG = 10.0  # of thighs and shanks in an upright rest pose, forward or backward of the vertical
_MAX_TRUNK_DEG = 25.0  # likewise of the line from hips to neck, which leans backward by 14 degrees in CMU's skeletons
_MAX_OFF_AXIS_DEG = 4.0  # nearer to one of the axes, a rest pose stands along that axis
_MAX_STANCE_DEG = 8.0  # of thighs and shanks of a person who stands; while walking, 12 degrees or more
_MAX_ASYMMETRY_DEG = 3.0  # between left and right limbs: 0 to 0.7 in poses set by programs, 4 to 20 in people who stand
_MAX_BONE_TURN_DEG = 20.0  # of a bone in its joint's frame, which a rotating joint keeps at 0
_REMEDY = "Export the motion again with an upright rest pose, or with a T-pose as its first frame."


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
    doubt : Finding, optional, that these come from a frame in which the person only about stands upright.
    """

    rate: float
    hip_centre: NDArray
    leg_length: float
    bones: Mapping[str, NDArray]
    across: Mapping[str, NDArray]
    upright: Mapping[str, NDArray]
    doubt: Finding | None = None

    def __len__(self) -> int:
        return len(self.hip_centre)

    def resampled(self, rate: float) -> BoneDirections:
        """The bone directions at another rate [Hz], interpolated linearly."""
        low, high, share = steps(len(self), self.rate, rate)

        def between(array: NDArray) -> NDArray:
            return (1 - share[:, None]) * array[low] + share[:, None] * array[high]

        return replace(
            self, rate=rate, hip_centre=between(self.hip_centre),
            bones={name: _unit(between(v)) for name, v in self.bones.items()},
            across={name: _unit(between(v)) for name, v in self.across.items()},
        )  # fmt: skip


def steps(frames: int, rate: float, new_rate: float) -> tuple[NDArray, NDArray, NDArray]:
    """The old frames (N,) int before and after each frame at a new rate [Hz], and the share (N,) of the latter.

    Raises
    ------
    ObservationError
        The new rate is not positive.
    """
    if not 0 < new_rate < np.inf:
        raise ObservationError(f"the rate {new_rate} is not positive", remedy="Give frames per second.")
    at = np.arange(int((frames - 1) / rate * new_rate + 1e-6) + 1) * (rate / new_rate)
    low = np.minimum(at.astype(int), frames - 1)
    return low, np.minimum(low + 1, frames - 1), at - low


def bone_directions(skeleton: SkeletonMotion, names: Mapping[str, str] | None = None) -> BoneDirections:
    """Directions of the bones of a recorded skeleton.

    Joint positions give them. What positions leave open (the zero of the trunk's angles, the rotation of head and hands
    about their own axes) comes from a pose in which the person stands upright: the rest pose, however it lies in its
    world, or else the frame with the straightest legs. So neither the axes of the joints nor the rest pose matter.

    Parameters
    ----------
    skeleton : SkeletonMotion
    names : segment -> name of a joint, optional
        See `bodies.joint_names.recorded_joints`; default: the skeleton's family is found by its joint names.

    Raises
    ------
    ObservationError
        The skeleton is of no known family; a bone of the trunk, the arms or the legs has no length; neither the rest
        pose nor a frame is upright; or the joints do not rotate with their bones.
    """
    found = recorded_joints(skeleton.names, names, source=skeleton.source)
    joints, R_up = found.joints, rotation_between_up(skeleton.up, "y")
    positions, rotations = skeleton.positions @ R_up.T, R_up @ skeleton.Ts_world_joint[..., :3, :3]
    known = found.upright is not None and {"eye_l", "thumb_l"} <= joints.keys()  # positions give all
    pose = None if known else _upright_pose(skeleton, found, positions, rotations)

    def turned(role: str, axis: str) -> NDArray:  # direction in the upright pose -> (F, 3) with the joint
        assert pose is not None
        return rotations[:, joints[role]] @ (pose.rotations[joints[role]].T @ getattr(pose, axis))

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
        bones["head"], across["head"] = end("head_top", "head") - neck, turned("head", "right")
    for s in SIDES:
        bones |= {f"{bone}_{s}": joint[f"{far}_{s}"] - joint[f"{bone}_{s}"] for bone, far in _NEXT_BONE.items()}
        bones[f"toes_{s}"] = end(f"toe_end_{s}", f"toes_{s}") - joint[f"toes_{s}"]
        bones[f"clavicle_{s}"] = joint[f"upperarm_{s}"] - neck
        bones[f"hand_{s}"] = end(f"knuckle_{s}", f"hand_{s}") - joint[f"hand_{s}"]
        palm = f"palm_{s}" if f"palm_{s}" in joints else f"hand_{s}"
        thumb = joint.get(f"thumb_{s}")
        across[f"hand_{s}"] = turned(palm, "forward") if thumb is None else thumb - joint[palm]
    legs = [np.linalg.norm(bones[f"{bone}_{side}"], axis=1).mean() for bone in ("thigh", "shank") for side in SIDES]
    for name, vector in bones.items():
        if not name.startswith(("hand", "toes")) and np.any(np.linalg.norm(vector, axis=1) < _MIN_BONE_LENGTH):
            raise ObservationError(f"the bone '{name}' has no length", file=skeleton.source or None)
    return BoneDirections(
        skeleton.rate, hip_centre, float(sum(legs) / 2),
        {name: _unit(v) for name, v in bones.items()}, {name: _unit(v) for name, v in across.items()},
        _upright(skeleton, found, pose), pose.doubt if pose else None,
    )


def _child(skeleton: SkeletonMotion, joint: int) -> int:
    """The first child of a joint; the joint itself if it has none, so that the bone has no direction."""
    children = np.flatnonzero(skeleton.parents == joint)
    return int(children[0]) if len(children) else joint


@dataclass(frozen=True, eq=False)
class _UprightPose:
    """Joints (J, 3) and their frames (J, 3, 3) of an upright person, y up, with directions (3,) right and forward."""

    positions: NDArray
    rotations: NDArray
    right: NDArray
    forward: NDArray
    doubt: Finding | None = None


def _upright_pose(skeleton: SkeletonMotion, found: Recorded, positions: NDArray, rotations: NDArray) -> _UprightPose:
    """The rest pose, rotated as a whole, if it is upright; else the frame whose legs are straightest.

    Positions (F, J, 3) and rotations (F, J, 3, 3) are those of the frames, y up.
    """
    for bone, far in _CHAINS:
        joint, end = found.joints[bone], found.joints[far]
        bone_in_joint = _unit(np.einsum("fji,fj->fi", rotations[:, joint], positions[:, end] - positions[:, joint]))
        if np.percentile(_angles(bone_in_joint, np.median(bone_in_joint, axis=0)), 90) > _MAX_BONE_TURN_DEG:
            raise ObservationError(
                f"the joint '{skeleton.names[joint]}' does not rotate with its bone: the file has "
                "positions alone, which leave the rotation of head and hands open", file=skeleton.source or None,
                remedy="Export the motion again, with the rotations of all joints.",
            )  # fmt: skip
    R = _turn_upright(skeleton.rest, found)
    x, frames, place = skeleton.rest @ R.T, np.broadcast_to(R, (len(skeleton.rest), 3, 3)), "the file's rest pose"
    if _leg_angle(x[None], found)[0] > _MAX_REST_DEG:
        angles = _leg_angle(positions, found)
        best = int(np.argmin(angles))
        if angles[best] > _MAX_STANCE_DEG:
            raise ObservationError(
                "the rest pose is no upright person, and the person stands upright with straight legs in no frame: "
                "the zero of the trunk's angles is unknown", file=skeleton.source or None, remedy=_REMEDY,
            )  # fmt: skip
        x, frames, place = positions[best], rotations[best], f"frame {best + 1}, as the rest pose is no upright person"
    right = _unit(x[found.joints["thigh_r"]] - x[found.joints["thigh_l"]])
    mirror = np.eye(3) - 2.0 * np.outer(right, right)
    bones = {name: x[found.joints[far]] - x[found.joints[name]] for name, far in _CHAINS}
    asymmetry = max(float(_angles(bones[f"{n}_l"] @ mirror, bones[f"{n}_r"])) for n in ("thigh", "shank", "upperarm"))
    doubt = Finding(
        "doubt", "rest", f"The angles of trunk, head and hands are zero as in {place}. A person stands there "
        f"({asymmetry:.0f}° between left and right), no pose set by a program: they may be off by some degrees, and "
        "the rotation of the forearms by more.", remedy=_REMEDY,
    )  # fmt: skip
    forward = _unit(np.cross([0.0, 1.0, 0.0], right))
    return _UprightPose(x, frames, right, forward, doubt if asymmetry > _MAX_ASYMMETRY_DEG else None)


def _turn_upright(rest: NDArray, found: Recorded) -> NDArray:
    """(3, 3) smallest rotation of a rest pose (J, 3) that brings the line from ankles to hips upright (y)."""
    hip_l, hip_r, foot_l, foot_r = (rest[found.joints[name]] for name in ("thigh_l", "thigh_r", "foot_l", "foot_r"))
    across = _unit(hip_r - hip_l)
    legs = hip_l + hip_r - foot_l - foot_r
    up = np.nan_to_num(_unit(legs - (legs @ across) * across))
    axis = np.eye(3)[np.argmax(np.abs(up))] * np.sign(up[np.argmax(np.abs(up))])
    return se3.shortest_turn(axis if _angles(up, axis) < _MAX_OFF_AXIS_DEG else up, np.array([[0.0, 1.0, 0.0]]))[0]


def _leg_angle(x: NDArray, found: Recorded) -> NDArray:
    """(F,) [deg] largest angle of hips, thighs and shanks from an upright stance, y up; inf where the trunk is bent.

    Poses x are (F, J, 3). Thighs and shanks count by their angle from the vertical in the sagittal plane, as legs may
    be apart.
    """
    joint = {role: x[:, index] for role, index in found.joints.items()}
    right = _unit(joint["thigh_r"] - joint["thigh_l"])
    forward = _unit(np.cross([0.0, 1.0, 0.0], right))

    def sagittal(v: NDArray) -> NDArray:
        ahead, above = _unit(np.stack([np.sum(v * forward, axis=1), v[:, 1]], axis=1)).T  # NaN of a lateral bone
        return np.degrees(np.arctan2(ahead, above))

    parts = [np.degrees(np.arcsin(right[:, 1])), *(sagittal(joint[bone] - joint[far]) for bone, far in _CHAINS[:4])]
    trunk = sagittal(joint["neck"] - 0.5 * (joint["thigh_l"] + joint["thigh_r"]))
    worst = np.abs(parts).max(axis=0)
    return np.where(np.isfinite(worst) & (np.abs(trunk) < _MAX_TRUNK_DEG), worst, np.inf)


def _angles(a: NDArray, b: NDArray) -> NDArray:
    """[deg] angles between directions (..., 3)."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def _upright(skeleton: SkeletonMotion, found: Recorded, pose: _UprightPose | None) -> dict[str, NDArray]:
    vectors = np.array(found.upright)
    if found.upright is None and pose is not None:
        joints, x = found.joints, pose.positions
        hips = x[[joints["thigh_l"], joints["thigh_r"]]].mean(axis=0)
        top = joints.get("head_top", _child(skeleton, joints["head"]))
        bones = np.diff([hips, *x[[joints["sacrum"], joints["spine"], joints["neck"], top]]], axis=0)
        vectors = np.stack([bones @ pose.forward, bones[:, 1]], axis=1)
    return dict(zip(("pelvis", "abdomen", "thorax", "head"), _unit(vectors)))


def _unit(vectors: NDArray) -> NDArray:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(norms >= _MIN_BONE_LENGTH, vectors / np.where(norms > 0, norms, 1.0), np.nan)
