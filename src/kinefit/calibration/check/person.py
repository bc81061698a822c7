"""What the person tells about the world: which way is up, where the floor is, left and right, how tall people are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.rigid_pairs import rigid_pairs
from kinefit.calibration.check.findings import Finding
from kinefit.calibration.check.views import Views
from kinefit.geometry.camera import Rig
from kinefit.motion import UP_AXES
from kinefit.readers.guess.views import nearest_axis, up_of_cameras, up_of_person

_WRONG = 45.0  # [deg] from which another axis is nearer
_LEANING = 20.0  # [deg] people stand, but not like poles
_FLOOR = 0.15  # [m] foot points lie above the sole, by up to this
_TALL = (1.2, 2.2)  # [m] of people
_LONG = 0.15  # [m] bones from here on are measured; shorter ones are mostly the detector's habits
_OTHER = 0.08  # share by which a stated height and the bones may differ: detectors' points are off the joints
_UNITS = {"mm": 1e3, "cm": 1e2, "dm": 1e1, "inch": 39.37}
_FEET = ("Ankle", "Heel", "BigToe", "SmallToe", "ankle", "heel", "foot_index")


def upright_findings(rig: Rig, x: NDArray, names: Sequence[str], up: str) -> list[Finding]:
    """Whether `up` points up, the floor lies under the feet, and left is left: x (F, K, 3) [m] points of the person."""
    axis, person, cameras = np.array(UP_AXES[up]), up_of_person(x, names), up_of_cameras(rig)
    ways = {"the cameras' images": cameras} | ({} if person is None else {"the person's head and feet": person})
    angles = {why: float(np.degrees(np.arccos(np.clip(way @ axis, -1, 1)))) for why, way in ways.items()}
    wrong = [why for why, angle in angles.items() if angle > _WRONG]
    if len(wrong) == len(angles):
        right, off = nearest_axis(cameras if person is None else person)
        how = "the floor would be the ceiling" if min(angles.values()) > 180 - _WRONG else "the person would lie"
        told = " and ".join(f"{why} ({angle:.0f} degrees off)" for why, angle in angles.items())
        sure = f"{'Sure' if len(angles) > 1 else 'Likely'}: by {told}."
        remedy = f'Write up = "{right}" into [take].'
        if off > _LEANING:
            remedy += f" It leans by {off:.0f} degrees."
        out = [Finding("fault", "up", f'up = "{up}" is wrong: {how}.', (), sure, remedy)]
        axis = np.array(UP_AXES[right])
    elif wrong:
        told = " and ".join(f"{why} show {nearest_axis(ways[why])[0]}" for why in wrong)
        remedy = "Look whether the person lies, or a camera stands on its side."
        out = [Finding("doubt", "up", f'up = "{up}" is not sure: {told}.', remedy=remedy)]
    elif min(angles.values()) > _LEANING:
        text = f'up = "{up}", but person and cameras lean by {min(angles.values()):.0f} degrees or more.'
        out = [Finding("doubt", "up", text, remedy="Is the floor of the calibration level?")]
    else:
        out = [Finding("good", "up", f'up = "{up}" is right, by {" and ".join(angles)}.')]
    return out + _floor_findings(x, names, axis) + _hand_findings(x, names)


def _floor_findings(x: NDArray, names: Sequence[str], up: NDArray) -> list[Finding]:
    feet = [k for k, name in enumerate(names) if any(part in name for part in _FEET)]
    heights = (x[:, feet] @ up).ravel()
    heights = heights[np.isfinite(heights)]
    if len(heights) < 10:
        return []
    floor = float(np.percentile(heights, 5))
    text = f"The lowest foot points are {100 * floor:+.0f} cm from the world's zero height"
    if abs(floor) < _FLOOR:
        return [Finding("good", "floor", f"{text}: the floor is at zero.")]
    remedy = "Nothing, unless heights above the floor are wanted: then move the world's origin."
    return [Finding("note", "floor", f"{text}: the floor is not at zero.", remedy=remedy)]


def _hand_findings(x: NDArray, names: Sequence[str]) -> list[Finding]:
    """Whether the person's left is where it must be, seen from above and from behind."""
    ears = [_index(names, side, "ear") for side in ("left", "right")]
    hips = [_index(names, side, "hip") for side in ("left", "right")]
    shoulders = [_index(names, side, "shoulder") for side in ("left", "right")]
    toes = [(_index(names, s, "foot_index"), _index(names, s, "heel")) for s in ("left", "right")]
    nose = next((k for k, name in enumerate(names) if name.lower() == "nose"), None)
    if None in hips or None in shoulders:
        return []
    side = x[:, hips[0]] - x[:, hips[1]] + x[:, shoulders[0]] - x[:, shoulders[1]]
    height = 0.5 * (x[:, shoulders[0]] + x[:, shoulders[1]] - x[:, hips[0]] - x[:, hips[1]])
    ahead = [x[:, nose] - 0.5 * (x[:, ears[0]] + x[:, ears[1]])] if nose is not None and None not in ears else []
    ahead += [x[:, toe] - x[:, heel] for toe, heel in toes if toe is not None and heel is not None]
    votes = (
        np.concatenate([np.sign(np.sum(side * np.cross(height, a), axis=-1)) for a in ahead]) if ahead else np.zeros(0)
    )
    votes = votes[np.isfinite(votes)]
    if len(votes) < 10 or votes.mean() > -0.5:
        return []
    text = "Left and right are exchanged: the person's face and toes point backwards."
    sure = f"Sure: so in {100 * np.mean(votes < 0):.0f} % of the frames."
    remedy = "The world is mirrored (a left-handed calibration, mirrored images), or the detector's names are."
    return [Finding("fault", "mirrored", text, (), sure, remedy)]


def _index(names: Sequence[str], side: str, joint: str) -> int | None:
    """Of a joint under a detector's spelling: "LHip", "left_hip", "LBigToe"."""
    short = {"foot_index": "BigToe"}.get(joint, joint.capitalize())
    return next((k for k, n in enumerate(names) if n in (f"{side}_{joint}", f"{side[0].upper()}{short}")), None)


def stature(body: Body, keypoint_sets: Sequence[str], views: Views, x: NDArray) -> float | None:
    """[m] height of the person by the median length of the bones seen; None where none is."""
    ratios = []
    for name in keypoint_sets:
        points = body.keypoints(name)
        columns = {n: views.names.index(n) for n in points.names if n in views.names}
        for i, j, _, length in rigid_pairs(body, points):
            a, b = columns.get(points.names[i]), columns.get(points.names[j])
            if a is not None and b is not None and length > _LONG:
                found = np.linalg.norm(x[:, a] - x[:, b], axis=-1)
                if np.isfinite(found).sum() >= 5:
                    ratios.append(float(np.nanmedian(found)) / length)
    return float(np.median(ratios)) * body.stature if len(ratios) >= 3 and body.stature else None


def size_findings(height: float | None, stated: float | None) -> list[Finding]:
    """Whether the person is as tall as people are: the calibration's unit and scale.

    Parameters
    ----------
    height : float [m] as measured, None where too little is seen.
    stated : float [m] as the take says.
    """
    if height is None:
        return [Finding("note", "scale", "Too few bones are seen to estimate the person's size.")]
    if not _TALL[0] <= height <= _TALL[1]:
        unit = min(_UNITS, key=lambda u: abs(np.log(height / 1.75 / _UNITS[u])))
        fits = abs(np.log(height / 1.75 / _UNITS[unit])) < 0.4
        remedy = (
            f'Write unit = "{unit}" into [calibration].' if fits
            else "Check the unit, and the size of the board's squares that the calibration was made with."
        )  # fmt: skip
        text = f"The person would be {height:.3g} m tall: the calibration's unit or scale is wrong."
        return [Finding("fault", "scale", text, (), "Sure, unless it is a child, a doll or an animal.", remedy)]
    if stated and abs(np.log(height / stated)) > _OTHER:
        text = f"The person measures {height:.2f} m by the long bones, and the take says {stated:.2f} m."
        sure = "Likely: a detector's points are a few per cent off the joints, not more."
        remedy = "Check height in [take], and the scale of the calibration."
        return [Finding("doubt", "scale", text, (), sure, remedy)]
    return [Finding("good", "scale", f"The person measures about {height:.2f} m by the long bones: the unit is right.")]
