"""The paper's synthetic test (P5 4.1): bodies of 13 segments/44 points and 15/49, posed at random, with exact truth.

The paper shows its bodies only in a figure. These have the same counts: up to six points per segment, most on the
trunk, and at each joint a point that both segments share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets import MarkerSet, SetSegment
from kinefit.geometry.se3 import exp_so3
from kinefit.markers.model.from_frame import model_from_frame
from kinefit.markers.model.model import MarkerModel

PLACES = {  # [m] right side and middle; x forward, y up, z right, from the middle of the hips
    "neck": (0.00, 0.54, 0.00), "chest": (0.11, 0.40, 0.03), "back": (-0.10, 0.33, -0.04), "waist": (0.00, 0.12, 0.00),
    "r_shoulder": (0.00, 0.48, 0.19), "r_temple": (0.06, 0.70, 0.08), "crown": (0.00, 0.79, 0.01),
    "occiput": (-0.09, 0.69, 0.02), "r_hip": (0.00, 0.00, 0.10), "r_asis": (0.10, 0.07, 0.12),
    "sacrum": (-0.11, 0.05, -0.01),
    "r_biceps": (0.06, 0.36, 0.21), "r_triceps": (-0.05, 0.30, 0.23), "r_elbow": (0.00, 0.19, 0.22),
    "r_radius": (0.05, 0.09, 0.25), "r_ulna": (-0.03, 0.03, 0.19), "r_wrist": (0.00, -0.07, 0.23),
    "r_thigh": (0.10, -0.18, 0.14), "r_hamstring": (-0.08, -0.28, 0.10), "r_knee": (0.00, -0.43, 0.11),
    "r_shin": (0.07, -0.55, 0.12), "r_calf": (-0.07, -0.62, 0.14), "r_ankle": (0.00, -0.85, 0.11),
    "r_heel": (-0.06, -0.90, 0.10), "r_toe": (0.17, -0.91, 0.12), "r_fifth": (0.10, -0.90, 0.18),
    "r_finger": (0.01, -0.24, 0.26), "r_thumb": (0.08, -0.16, 0.21),
}  # fmt: skip
TREE = (
    ("trunk", None, None, ("neck", "chest", "back", "waist", "r_shoulder", "l_shoulder")),
    ("head", "trunk", "neck", ("neck", "r_temple", "l_temple", "crown", "occiput")),
    ("pelvis", "trunk", "waist", ("waist", "r_hip", "l_hip", "r_asis", "sacrum")),
    ("upper_arm_r", "trunk", "r_shoulder", ("r_shoulder", "r_biceps", "r_triceps", "r_elbow")),
    ("forearm_r", "upper_arm_r", "r_elbow", ("r_elbow", "r_radius", "r_ulna", "r_wrist")),
    ("thigh_r", "pelvis", "r_hip", ("r_hip", "r_thigh", "r_hamstring", "r_knee")),
    ("shank_r", "thigh_r", "r_knee", ("r_knee", "r_shin", "r_calf", "r_ankle")),
    ("foot_r", "shank_r", "r_ankle", ("r_ankle", "r_heel", "r_toe", "r_fifth")),
    ("hand_r", "forearm_r", "r_wrist", ("r_wrist", "r_finger", "r_thumb")),
)
PLACING = 0.008
"""[m] standard deviation of left and right markers from mirror symmetry; markers at joints are symmetric."""


@dataclass(frozen=True, eq=False)
class SyntheticPose:
    """An unlabelled frame of a posed body with its true labels.

    Parameters
    ----------
    points : (N, 3) [m], in random order
    truth : (M,) int, the point of each label of the model; -1 if it is missing
    """

    points: NDArray
    truth: NDArray


def synthetic_body(points: int = 44) -> MarkerModel:
    """The paper's body of 13 segments and 44 points, or of 15 segments (with hands) and 49 points.

    Parameters
    ----------
    points : 44 or 49
    """
    tree = [row for row in TREE if points > 44 or not row[0].startswith("hand")]
    full: list[tuple[str, str, str, list[str]]] = []  # name, parent, joint (empty for the root), markers
    for name, parent, joint, markers in tree:
        for side in ("r", "l") if name.endswith("_r") else ("r",):
            own = [_sided(m, side) for m in markers]
            full.append((_sided(name, side), _sided(parent or "", side), _sided(joint or "", side), own))
    if points > 44:
        full[2][3].append("l_asis")
    labels = tuple(dict.fromkeys(m for *_, markers in full for m in markers))
    joints = {joint for _, _, joint, _ in full}
    rng = np.random.default_rng(0)
    at = np.array([PLACES[m] if m in PLACES else np.multiply(PLACES["r" + m[1:]], (1, 1, -1)) for m in labels])
    at += PLACING * rng.standard_normal(at.shape) * np.array([m not in joints for m in labels])[:, None]
    names = [name for name, *_ in full]
    segments = tuple(
        SetSegment(name, names.index(parent), tuple(markers), at[labels.index(joint)])
        if parent
        else SetSegment(name, -1, tuple(markers))
        for name, parent, joint, markers in full
    )
    return model_from_frame(at, labels, MarkerSet(f"synthetic_{len(labels)}", labels, at, segments))


def _sided(name: str, side: str) -> str:
    if side == "r":
        return name
    return "l" + name[1:] if name.startswith("r_") else name[:-1] + "l" if name.endswith("_r") else name


def random_pose(
    model: MarkerModel,
    rng: np.random.Generator,
    *,
    rotation: float | None = None,
    distortion: float = 0.0,
    missing: float = 0.0,
    extra: int = 0,
) -> SyntheticPose:
    """Draw a random pose of a body, like P5 4.1.

    Parameters
    ----------
    rotation : [rad]
        Largest angle: every segment turns about its joint (the root about its centre) by a uniform angle about a
        random axis. Default: uniformly random rotations.
    distortion : share of a segment's mean distance l, without unit
        Zero-mean Gaussian noise N(0, distortion l) / √6 is added to each coordinate of each point.
    missing : probability that a point is missing
    extra : number of random points in the body's bounding box, enlarged by 0.2 m on each side
    """
    places = np.array(model.reference)
    noise = np.zeros(len(model))
    Ts: list[tuple[NDArray, NDArray]] = []
    joint_of = {j.child: j for j in model.joints}
    posed: set[int] = set()
    for s, markers in enumerate(model.segments):
        turn, x = _turn(rng, rotation), model.reference[list(markers)]
        if s in joint_of:
            R_parent, t_parent = Ts[joint_of[s].parent]
            joint = R_parent @ joint_of[s].in_parent + t_parent
            R = R_parent @ turn
            t = joint - R @ joint_of[s].in_child
        else:
            R, t = turn, x.mean(0) - turn @ x.mean(0) + rng.uniform(-2.0, 2.0, 3)
        Ts.append((R, t))
        length = mean_length(x)
        for m in markers:
            if m not in posed:
                places[m] = R @ model.reference[m] + t
                noise[m] = distortion * length / np.sqrt(6.0)
        posed |= set(markers)
    places += noise[:, None] * rng.standard_normal(places.shape)
    visible = rng.random(len(model)) >= missing
    low, high = places.min(0) - 0.2, places.max(0) + 0.2
    points = np.vstack([places[visible], rng.uniform(low, high, (extra, 3))])
    order = rng.permutation(len(points))
    truth = np.full(len(model), -1)
    truth[visible] = np.argsort(order)[: visible.sum()]
    return SyntheticPose(points[order], truth)


def mean_length(x: NDArray) -> float:
    """Mean distance l [m] of a segment's points x (k, 3) (P5, below equation 3)."""
    i, j = np.triu_indices(len(x), 1)
    return float(np.linalg.norm(x[i] - x[j], axis=-1).mean())


def _turn(rng: np.random.Generator, rotation: float | None) -> NDArray:
    if rotation is None:
        q = rng.standard_normal(4)
        angle = 2 * np.arctan2(np.linalg.norm(q[1:]), q[0])
        return exp_so3(angle * q[1:] / np.linalg.norm(q[1:]))
    axis = rng.standard_normal(3)
    return exp_so3(rng.uniform(0.0, rotation) * axis / np.linalg.norm(axis))
