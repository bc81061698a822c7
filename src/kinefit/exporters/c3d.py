"""C3D: joint centres, landmarks and angles over time, for programs of motion laboratories."""

from __future__ import annotations

from os import PathLike

import numpy as np

from kinefit._arguments import checked
from kinefit._files import write_bytes
from kinefit.errors import ExportError
from kinefit.exporters.c3d_file import MAX_FRAMES, Groups, c3d_bytes, label_groups, screens
from kinefit.exporters.curves import Curve, curves
from kinefit.exporters.skeletons.common import UNITS, bone_names, convention, length_factor, plain_names, turned
from kinefit.motion import Motion


@checked
def write_c3d(
    motion: Motion, path: str | PathLike[str], *, unit: str = "mm", up: str | None = None, names: str = "kinefit"
) -> None:
    """Write joint centres, then landmarks, then angles, as C3D.

    A landmark that bears a joint's name gets a number ("neck_2").
    Centres and landmarks are there in all frames, with residual 0: computed, not measured. Angles are points that
    POINT:ANGLES lists, as laboratories' programs expect them: the coordinates of a joint in degrees as x, y and z, as
    `LHipAngles`; missing in frames in which none of them is observed. The first frame's number follows from its time,
    frame 1 being at 0 s.

    Parameters
    ----------
    motion : Motion
    path : path
    unit : "mm", "cm" or "m"
    up : str, optional
        Vertical axis of the file's world, which POINT:Y_SCREEN tells. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
        Labels of the joint centres: names of their segments; with "kinefit" of the joints.

    Raises
    ------
    ExportError
        No frame, too many points, unknown unit, axis or names, or the file cannot be written.
    """
    body, factor, up = motion.body, length_factor(unit, UNITS, path), up or motion.up
    bones = list(body.joints) if convention(names) == "kinefit" else bone_names(body, names, path)
    angles = _angles(motion)
    labels = plain_names([*bones, *body.landmarks.names, *angles])
    about = [f"joint centre {joint}" for joint in body.joints] + ["landmark"] * len(body.landmarks)
    about += [f"{', '.join(c.name for c in found)} [deg]" for found in angles.values()]
    first = round(float(motion.times[0]) * motion.rate) + 1 if len(motion) else 0
    if not (len(motion) and len(labels) <= MAX_FRAMES and first > 0):
        raise ExportError(
            f"C3D cannot hold {len(motion)} frames of {len(labels)} points from frame {first} on", file=path,
            remedy="Cut the motion to frames of time 0 and later, and at least one.",
        )
    world = turned(motion, up, path)
    places = factor * np.concatenate([world.segment_poses()[..., :3, 3], world.positions()], axis=1)
    turned_by = np.zeros((len(motion), len(angles), 3))
    fourth = np.zeros((len(motion), len(labels)))
    for k, found in enumerate(angles.values()):
        turned_by[:, k, : len(found)] = np.stack([c.values for c in found], axis=1)
        fourth[~np.isfinite([c.std for c in found]).any(axis=0), places.shape[1] + k] = -1.0
    turned_by[fourth[:, places.shape[1] :] < 0] = 0.0
    points = np.concatenate([places, turned_by], axis=1)
    groups: Groups = {
        "POINT": {
            "UNITS": [unit], "ANGLE_UNITS": ["deg"], "ANGLES": labels[places.shape[1] :], **screens(up),
            **label_groups(labels, about),
        },
        "ANALOG": {"USED": np.array(0, np.uint16), "RATE": np.array(motion.rate, np.float32), "LABELS": []},
    }  # fmt: skip
    write_bytes(path, c3d_bytes(points, fourth, groups, scale=-1.0, rate=motion.rate, first=first))


def _angles(motion: Motion) -> dict[str, list[Curve]]:
    """{label: up to three coordinates} of every joint that turns, the root's first."""
    out: dict[str, list[Curve]] = {}
    for curve in curves(motion):
        if curve.unit == "deg":
            side = {"left": "L", "right": "R"}.get(curve.side, "")
            label, number = f"{side}{curve.joint.capitalize()}Angles", 1
            while len(out.get(label, ())) == 3:
                number += 1
                label = f"{side}{curve.joint.capitalize()}Angles{number}"
            out.setdefault(label, []).append(curve)
    return out
