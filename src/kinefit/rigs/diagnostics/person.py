"""Check the world by the person in it: vertical, floor, left and right, scale.

Check what a depth camera's images say of its unit, its lens and its kind of distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.limbs import rigid_pairs
from kinefit.bodies.motion import UP_AXES
from kinefit.findings import Edit, Finding, Severity, in_words, listed
from kinefit.fitting.multiview.views import KeypointViews
from kinefit.geometry.camera import Rig
from kinefit.images.depth_scene import background_model, foreground
from kinefit.observations import DepthVideo
from kinefit.readers.guess.views import nearest_axis, up_of_cameras, up_of_person
from kinefit.readers.take.file import Take

_MAX_UP_ANGLE = 45.0  # [deg] beyond which another axis is nearer
_MAX_LEAN = 20.0  # [deg] of a standing person
_MAX_FLOOR_HEIGHT = 0.15  # [m] of foot points, which lie above the sole
# [m] From the smallest boys of eight (CDC growth charts, Kuczmarski et al. 2002, Vital and Health Statistics 11(246):
# 5th percentile 1.18 m) to the tallest men (2.03 m, 1 in 1,000), whose bones two noisy cameras measure 13 % too long.
_MIN_STATURE, _MAX_STATURE = 1.2, 2.3
# [m] Adults: women are 1.629 +- 0.064 m tall, men 1.756 +- 0.069 m (Gordon et al., 2012 anthropometric survey of U.S.
# Army personnel, NATICK/TR-15/007); below and above, one in 300 women and one in 10,000 men.
_MIN_ADULT_STATURE = 1.45
_MAX_ADULT_STATURE = 2.03
_MIN_BONE_LENGTH = 0.15  # [m] shorter bones are dominated by systematic errors of the detector
_MAX_STATURE_ERROR = 0.08  # log ratio of the measured to the stated height: detected points are off the joints
_MIN_SCALE_FAULT = 0.22  # the same, about three times as much: beyond any detector and build
_MIN_ORDER_SPREAD = 0.35  # [log] of ratios of bones: 0.07 to 0.26 in recordings, 0.44 to 0.85 in wrong orders of points
_MIN_KNEE_BEND = np.radians(20.0)  # of a knee that indicates the forward direction
_UNIT_TOLERANCE = 0.4  # log ratio: people differ by 1.25 in size, and detectors add to it
_UNITS = {"mm": 1e3, "cm": 1e2, "dm": 1e1, "inch": 39.37}
_FEET = ("Ankle", "Heel", "BigToe", "SmallToe", "ankle", "heel", "foot_index")


def upright_findings(rig: Rig, x: NDArray, names: Sequence[str], up: str) -> list[Finding]:
    """Check the vertical `up`, the floor, and left and right, by the person's points x (F, K, 3) [m]."""
    axis, person, cameras = np.array(UP_AXES[up]), up_of_person(x, names), up_of_cameras(rig)
    ways = {"the cameras' images": cameras} | ({} if person is None else {"the person's head and feet": person})
    angles = {why: float(np.degrees(np.arccos(np.clip(way @ axis, -1, 1)))) for why, way in ways.items()}
    wrong = [why for why, angle in angles.items() if angle > _MAX_UP_ANGLE]
    if len(wrong) == len(angles) and person is not None:
        right, off = nearest_axis(person)
        how = "the floor would be the ceiling" if min(angles.values()) > 180 - _MAX_UP_ANGLE else "the person would lie"
        evidence = " and ".join(f"{why} ({angle:.0f} degrees off)" for why, angle in angles.items())
        edits = (Edit("take", "up", f'"{right}"'),)
        leans = f" The person leans from this axis by {off:.0f} degrees." if off > _MAX_LEAN else ""
        text, remedy = f'up = "{up}" is wrong: {how}.', f"Write {in_words(edits)}.{leans}"
        out = [Finding("fault", "up", text, (), f"Certain, by {evidence}.", remedy, edits)]
        axis = np.array(UP_AXES[right])
    elif wrong:
        evidence = " and ".join(f"{why} show {nearest_axis(ways[why])[0]}" for why in wrong)
        remedy = "Check up in [take], unless the person lies or a camera is rotated by 90 degrees."
        out = [Finding("doubt", "up", f'up = "{up}" is uncertain: {evidence}.', remedy=remedy)]
    elif min(angles.values()) > _MAX_LEAN:
        text = f'up = "{up}", but person and cameras lean by {min(angles.values()):.0f} degrees or more.'
        out = [Finding("doubt", "up", text, remedy="Check that the calibration's floor is level.")]
    else:
        out = [Finding("good", "up", f'up = "{up}" is right, by {" and ".join(angles)}.')]
    return out + _floor_findings(x, names, axis) + _hand_findings(x, names)


def _floor_findings(x: NDArray, names: Sequence[str], up: NDArray) -> list[Finding]:
    feet = [k for k, name in enumerate(names) if any(part in name for part in _FEET)]
    heights = x[:, feet] @ up
    heights = heights[np.isfinite(heights)]
    if len(heights) < 10:
        return []
    floor = float(np.percentile(heights, 5))
    text = f"The lowest foot points are {100 * floor:+.0f} cm from height zero of the world"
    if abs(floor) < _MAX_FLOOR_HEIGHT:
        return [Finding("good", "floor", f"{text}: the floor is at zero.")]
    remedy = "For heights above the floor, move the origin of the calibration onto the floor. Else nothing."
    return [Finding("note", "floor", f"{text}: the floor is not at zero.", remedy=remedy)]


def _hand_findings(x: NDArray, names: Sequence[str]) -> list[Finding]:
    """Check left and right against the forward direction of the person.

    Forward is the nose relative to the ears, the toes relative to the heels, and the bent knees.
    """
    point = lambda k: np.full_like(x[:, 0], np.nan) if k is None else x[:, k]
    nose = point(next((k for k, name in enumerate(names) if name.lower() == "nose"), None))
    joints = "ear", "shoulder", "hip", "knee", "ankle", "heel", "foot_index"
    left, right = ({joint: point(_index(names, side, joint)) for joint in joints} for side in ("left", "right"))
    side = left["hip"] - right["hip"] + left["shoulder"] - right["shoulder"]
    height = 0.5 * (left["shoulder"] + right["shoulder"] - left["hip"] - right["hip"])
    ahead = [nose - 0.5 * (left["ear"] + right["ear"])]
    for at in (left, right):
        ahead += [at["foot_index"] - at["heel"], _ahead_of_knee(at["hip"], at["knee"], at["ankle"])]
    votes = np.concatenate([np.sign(np.sum(side * np.cross(height, a), axis=-1)) for a in ahead])
    votes = votes[np.isfinite(votes)]
    if len(votes) < 10 or votes.mean() > -0.5:
        return []
    text = "Left and right are swapped: the person's face, toes and knees point backwards."
    confidence = f"Certain: in {100 * np.mean(votes < 0):.0f} % of the frames, while the cameras agree."
    remedy = "Check format and set in [[keypoints]], or swap the names of left and right there. If images and "
    remedy += "calibration were mirrored together, mirror the videos back, then calibrate and detect again."
    return [Finding("fault", "mirrored", text, (), confidence, remedy)]


def _ahead_of_knee(hip: NDArray, knee: NDArray, ankle: NDArray) -> NDArray:
    """Vector (F, 3) [m] from the middle of hip and ankle to the knee; NaN where the knee is nearly straight."""
    thigh, shank = knee - hip, ankle - knee
    lengths = np.linalg.norm(thigh, axis=-1) * np.linalg.norm(shank, axis=-1)
    bent = np.sum(thigh * shank, axis=-1) < np.cos(_MIN_KNEE_BEND) * lengths
    return np.where(bent[:, None], knee - 0.5 * (hip + ankle), np.nan)


def _index(names: Sequence[str], side: str, joint: str) -> int | None:
    """Index of a joint in a detector's spelling: "LHip", "left_hip", "LBigToe"; None without it."""
    short = {"foot_index": "BigToe"}.get(joint, joint.capitalize())
    return next((k for k, n in enumerate(names) if n in (f"{side}_{joint}", f"{side[0].upper()}{short}")), None)


def bone_ratios(body: Body, keypoint_sets: Sequence[str], views: KeypointViews, x: NDArray) -> NDArray:
    """(N,) median lengths of the bones in x (F, K, 3) [m], relative to the body's; empty with too few."""
    ratios = []
    for name in keypoint_sets:
        points = body.keypoints(name)
        columns = {n: views.names.index(n) for n in points.names if n in views.names}
        for i, j, _, length in rigid_pairs(body, points):
            a, b = columns.get(points.names[i]), columns.get(points.names[j])
            if a is not None and b is not None and length > _MIN_BONE_LENGTH:
                found = np.linalg.norm(x[:, a] - x[:, b], axis=-1)
                if np.isfinite(found).sum() >= 5:
                    ratios.append(float(np.nanmedian(found)) / length)
    return np.array(ratios if len(ratios) >= 3 else ())


def stature(body: Body, ratios: NDArray) -> float | None:
    """Height [m] of the person by the median of `bone_ratios`; None with too few."""
    return float(np.median(ratios)) * body.stature if len(ratios) and body.stature else None


def order_findings(ratios: NDArray, keypoint_sets: Sequence[str]) -> list[Finding]:
    """Find keypoints that are in the order of another set: the `bone_ratios` contradict each other."""
    if not len(ratios) or np.std(np.log(ratios)) < _MIN_ORDER_SPREAD:
        return []
    text = f"The keypoints are not those of {listed(keypoint_sets)}, or are in another order: bones are "
    text += f"{ratios.min():.2g} to {ratios.max():.2g} times as long as a person's."
    remedy = "Check format and set in [[keypoints]], and the order in which the points are written."
    return [Finding("fault", "set", text, (), "Certain: no scale of the calibration explains it.", remedy)]


def size_findings(height: float | None, stated: float | None) -> list[Finding]:
    """Check unit and scale of the calibration by the person's height.

    Parameters
    ----------
    height : float [m] as measured; None if too few bones were measured.
    stated : float [m] as the take states it; None if it does not.
    """
    if height is None:
        return [Finding("note", "scale", "Too few bones are visible to estimate the person's size.")]
    ratio = 0.0 if stated is None else abs(np.log(height / stated))
    if ratio > _MAX_STATURE_ERROR:
        text = f"The person is {height:.3g} m tall by the long bones, but height = {stated:.2f} m in the take."
        confidence = "Likely: the error of detected joints is a few per cent at most."
        way, edits = _unit_remedy(height / (stated or 1.0))
        remedy = f"Check height in [take], and the scale of the calibration{way}."
        severity: Severity = "fault" if ratio > _MIN_SCALE_FAULT else "doubt"
        return [Finding(severity, "scale", text, (), confidence, remedy, edits)]
    if stated is None and not _MIN_STATURE <= height <= _MAX_STATURE:
        text = f"The person would be {height:.3g} m tall: the calibration's unit or scale is wrong. "
        text += f"People are {_MIN_STATURE} to {_MAX_STATURE} m tall."
        way, edits = _unit_remedy(height / 1.75)
        remedy = f"Check the unit of the calibration, and the size of the board's squares{way}. "
        remedy += "For a child, write height = ... into [take]."
        confidence = "Certain, unless it is a child, a doll or an animal."
        return [Finding("fault", "scale", text, (), confidence, remedy, edits)]
    if stated is None and not _MIN_ADULT_STATURE <= height <= _MAX_ADULT_STATURE:
        limits = f"below {_MIN_ADULT_STATURE} m or above {_MAX_ADULT_STATURE} m"
        text = f"The person would be {height:.2f} m tall. Few adults are {limits}."
        remedy = "Either the scale is wrong (check the size of the board's squares; without a calibration the scale is "
        remedy += "unknown), or a child is in view. Write height = ... into [take]."
        return [Finding("doubt", "scale", text, (), "", remedy)]
    return [Finding("good", "scale", f"The person is about {height:.2f} m tall by the long bones: the unit is right.")]


def _unit_remedy(ratio: float) -> tuple[str, tuple[Edit, ...]]:
    """The line of the take that corrects lengths by this ratio, or the ratio if no unit explains it."""
    unit = min(_UNITS, key=lambda u: abs(abs(np.log(ratio)) - np.log(_UNITS[u])))
    if abs(abs(np.log(ratio)) - np.log(_UNITS[unit])) < _UNIT_TOLERANCE:
        edits = (Edit("calibration", "unit", f'"{unit if ratio > 1.0 else "m"}"'),)
        into = " into " if ratio > 1.0 else f', not "{unit}", into '
        return f": write {in_words(edits, into)}", edits
    return f" (lengths are about {ratio:.2g} times what they should be)", ()


_MAX_IMAGES = 16  # of a recording, spread over it
_MIN_BLOB_SHARE = 0.01  # of the image that moves before the background
_MAX_PERSON_EXTENT = 2.7  # [m] of what moves: a person with an arm stretched upwards has 2.6
_TYPICAL_EXTENT = 1.7  # [m]
_MAX_CENTRE_OFFSET = 0.15  # of the image's side, of the principal point: of depth cameras below 0.06
_MIN_PLANE_POINTS = 500
_PLANE_SAMPLES = 300
_PLANE_ERROR = 0.006  # of the distance, of points on a plane
_MIN_PLANE_SHARE = 0.25  # of the image, on its largest plane
_MIN_PLANE_GAIN = 1.3  # of the plane's points, if distances are along the rays

UNCHECKED = (
    "Depth alone: not checked are the poses of its cameras, whether the image is mirrored, whether the intrinsics are "
    "those of another stream, and the unit where no person moves."
)
"""What `kinefit check` cannot say of depth without videos."""


def depth_findings(take: Take, videos: Sequence[DepthVideo]) -> list[Finding]:
    """Findings on units, principal points and distances along rays of a take's depth cameras."""
    out, units = list[Finding](), {entry.name: entry.unit or 0.001 for entry in take.depth}
    for video in videos:
        if video.camera is not None and video.sensor in units:
            sample = np.unique(np.linspace(0, len(video) - 1, _MAX_IMAGES, dtype=int))
            images = [video.frame(int(i)).depth for i in sample]
            out += _unit(video, images, units[video.sensor]) + _centre(video) + _along_rays(video, images[0])
    return out


def moving_extent(video: DepthVideo, images: Sequence[NDArray]) -> float | None:
    """Largest side [m] of the box of what moves before the background, median of images (H, W) [m]; None if unclear."""
    assert video.camera is not None
    empty = images if video.background is None else [video.background.frame(0).depth]
    background = background_model(empty, share=0.2 if video.background is None else 0.5)
    extents = []
    for depth in images:
        moves = depth > 0.0 if video.on_body else foreground(depth, background) & (background > 0.0)
        labels, stats = cv2.connectedComponentsWithStats(moves.astype(np.uint8), connectivity=4)[1:3]
        blob = int(np.argmax(stats[:, cv2.CC_STAT_AREA] * (np.arange(len(stats)) > 0)))
        if blob and stats[blob, cv2.CC_STAT_AREA] > _MIN_BLOB_SHARE * depth.size:
            sides = stats[blob, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]] / np.diag(video.camera.matrix)[:2]
            extents.append(float(np.median(depth[labels == blob]) * sides.max()))
    return float(np.median(extents)) if 2 * len(extents) >= len(images) else None


def _unit(video: DepthVideo, images: Sequence[NDArray], unit: float) -> list[Finding]:
    """A moving thing that is too large to be a person."""
    extent = moving_extent(video, images)
    if extent is None or extent < _MAX_PERSON_EXTENT:
        return []
    text = f"What moves before {video.sensor} is {extent:.3g} m large in most images: a person is smaller."
    remedy = f"Write its unit [m of a count]: about {unit * _TYPICAL_EXTENT / extent:.1g} would fit a person."
    return [Finding("doubt", "unit", text, (video.sensor,), "A guess.", remedy)]


def _centre(video: DepthVideo) -> list[Finding]:
    """A principal point far from the middle of the image."""
    assert video.camera is not None
    centre, size = video.camera.matrix[:2, 2], np.array(video.size)
    off = float(np.abs((centre - (size - 1) / 2.0) / size).max())
    if off < _MAX_CENTRE_OFFSET:
        return []
    text = f"The principal point of {video.sensor}, {centre[0]:.4g}, {centre[1]:.4g}, is {100 * off:.0f} % of a side "
    remedy = "Give the intrinsics of the depth stream at this size, not those of the colour stream."
    return [Finding("doubt", "intrinsics", f"{text}off its middle.", (video.sensor,), "A guess.", remedy)]


def _along_rays(video: DepthVideo, depth: NDArray) -> list[Finding]:
    """Distances along the rays, given as depth: walls and floors are curved."""
    assert video.camera is not None
    step = max(int(np.sqrt(depth.size / 5000)), 1)
    z, table = depth[::step, ::step].ravel(), video.camera.ray_table[:, ::step, ::step].reshape(2, -1)
    known = (z > 0.0) & np.isfinite(table).all(axis=0)
    rays = np.column_stack([*table[:, known], np.ones(known.sum())])
    points = rays * z[known, None]
    shares = [known.mean() * _plane_share(x) for x in (points, points / np.linalg.norm(rays, axis=1)[:, None])]
    if shares[1] < max(_MIN_PLANE_SHARE, _MIN_PLANE_GAIN * shares[0]):
        return []
    on_plane = f"{100 * shares[0]:.0f} and {100 * shares[1]:.0f} % of the pixels lie on it"
    text = f"A wall before {video.sensor} is curved by its depths, and flat if they are along rays ({on_plane})."
    remedy = "Convert them: depth = distance / |ray|, with ray = ((u - cx) / fx, (v - cy) / fy, 1)."
    return [Finding("doubt", "radial", text, (video.sensor,), "A guess.", remedy)]


def _plane_share(x: NDArray) -> float:
    """Share of points (N, 3) [m] on their largest plane, by random triples."""
    if len(x) < _MIN_PLANE_POINTS:
        return 0.0
    rng = np.random.default_rng(0)
    a, b, c = x[rng.integers(0, len(x), (3, _PLANE_SAMPLES))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals, a = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None], a[lengths > 1e-9]
    off = np.abs(x @ normals.T - np.einsum("ij,ij->i", normals, a))
    return float((off < _PLANE_ERROR * np.linalg.norm(x, axis=1)[:, None]).mean(axis=0).max(initial=0.0))
