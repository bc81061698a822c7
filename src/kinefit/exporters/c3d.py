"""C3D: joint centres and landmarks over time, for programs of motion laboratories."""

from __future__ import annotations

from os import PathLike

import numpy as np

from kinefit.errors import ExportError
from kinefit.exporters.atomic import write_bytes
from kinefit.exporters.c3d_file import MOST, Groups, c3d_bytes, label_groups, screens
from kinefit.exporters.skeletons.common import UNITS, bone_names, convention, length_factor, plain_names, turned
from kinefit.motion import Motion


def write_c3d(
    motion: Motion, path: str | PathLike[str], *, unit: str = "mm", up: str | None = None, names: str = "kinefit"
) -> None:
    """Write joint centres, then landmarks, as C3D; a landmark that bears a joint's name gets a number ("neck_2").

    All points are there in all frames, with residual 0: computed, not measured. The first frame's number follows from
    its time, frame 1 being at 0 s.

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
    labels = plain_names([*bones, *body.landmarks.names])
    about = [f"joint centre {joint}" for joint in body.joints] + ["landmark"] * len(body.landmarks)
    first = round(float(motion.times[0]) * motion.rate) + 1 if len(motion) else 0
    if not (len(motion) and len(labels) <= MOST and first > 0):
        raise ExportError(
            f"C3D cannot hold {len(motion)} frames of {len(labels)} points from frame {first} on", file=path,
            remedy="Cut the motion to frames of time 0 and later, and at least one.",
        )
    world = turned(motion, up, path)
    points = factor * np.concatenate([world.segment_poses()[..., :3, 3], world.positions()], axis=1)
    groups: Groups = {
        "POINT": {"UNITS": [unit], **screens(up), **label_groups(labels, about)},
        "ANALOG": {"USED": np.array(0, np.uint16), "RATE": np.array(motion.rate, np.float32), "LABELS": []},
    }
    write_bytes(path, c3d_bytes(points, np.zeros(points.shape[:2]), groups, scale=-1.0, rate=motion.rate, first=first))
