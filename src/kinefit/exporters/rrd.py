"""RRD: a motion for the viewer of Rerun, beside whatever else was recorded."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np

from kinefit._files import writing
from kinefit.errors import ExportError, extra
from kinefit.exporters.skeletons.common import bone_names, turned
from kinefit.motion import Motion


def write_rrd(motion: Motion, path: str | PathLike[str], *, up: str | None = None, names: str = "kinefit") -> None:
    """Write a motion as a recording of Rerun, in metres and degrees, over the timelines `time` and `frame`.

    - `world/joints`: joint centres, labelled by segment; `world/bones`: lines from each to the one above it.
    - `world/uncertainty`: ellipsoids of two standard deviations about joint centres; none where they are infinite.
    - `angles/NAME` and `std/NAME`: coordinates and their standard deviations (metres where they slide).
    - `quality`: that of each frame.

    Parameters
    ----------
    motion : Motion
    path : path
    up : str, optional
        Vertical axis of the file's world, which it states. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
        Labels of the joints.

    Raises
    ------
    ExportError
        The extra "rerun" is not installed, no frame, unknown axis or names, or the file cannot be written.
    """
    with extra("rerun", "RRD needs the package rerun-sdk", ExportError, file=path):
        import rerun as rr
    if not len(motion):
        raise ExportError("a motion without frames has nothing to show", file=path, remedy="Track the take first.")
    world, labels = turned(motion, up or motion.up, path), bone_names(motion.body, names, path)
    with writing(path) as temporary:
        recording = rr.RecordingStream("kinefit")
        try:
            recording.save(str(temporary))
            _log(rr, recording, world, labels)
            recording.flush()
        except RuntimeError as error:
            raise ExportError(f"Rerun cannot write it ({error})", file=path, remedy="Check the disk.") from error
        finally:
            recording.disconnect()


def _log(rr: Any, recording: Any, motion: Motion, labels: list[str]) -> None:
    tree, centres, std = motion.body.tree, motion.joint_centres, motion.joint_std
    count, joints = centres.shape[:2]
    index = [rr.TimeColumn("time", duration=motion.times), rr.TimeColumn("frame", sequence=np.arange(count))]

    def columns(entity: str, values: Any) -> None:
        recording.send_columns(entity, indexes=index, columns=values)

    axis = f"RIGHT_HAND_{motion.up[-1].upper()}_{'DOWN' if motion.up.startswith('-') else 'UP'}"
    recording.log("world", getattr(rr.ViewCoordinates, axis), static=True)
    recording.log("world/joints", rr.Points3D.from_fields(labels=labels, show_labels=False), static=True)
    each = [joints] * count
    columns("world/joints", rr.Points3D.columns(positions=centres.reshape(-1, 3)).partition(lengths=each))
    below = np.flatnonzero(tree.parents >= 0)
    strips = np.stack([centres[:, tree.parents[below]], centres[:, below]], axis=2).reshape(-1, 2, 3)
    columns("world/bones", rr.LineStrips3D.columns(strips=list(strips)).partition(lengths=[len(below)] * count))
    known = np.isfinite(std).all(axis=2)
    ellipsoids = rr.Ellipsoids3D.columns(centers=centres[known], half_sizes=2.0 * std[known])
    columns("world/uncertainty", ellipsoids.partition(lengths=known.sum(axis=1)))
    factors = np.where(tree.prismatic, 1.0, np.degrees(1.0))
    for d, name in enumerate(tree.coordinates):
        columns(f"angles/{name}", rr.Scalars.columns(scalars=factors[d] * motion.angles[:, d]))
        columns(f"std/{name}", rr.Scalars.columns(scalars=factors[d] * motion.dof_std[:, 6 + d]))
    columns("quality", rr.Scalars.columns(scalars=motion.quality))
