"""OpenSim: landmarks over time (.trc), angles over time (.mot) and the fitted body as a model (.osim).

All three stand in OpenSim's world, y up (TRC by default). The root's coordinates are those of OpenSim's
ground_pelvis joint: the way of its origin, then turns about its own z (tilt), x (list) and y (rotation).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from itertools import chain, count
from os import PathLike
from pathlib import Path

import numpy as np

from kinefit._arguments import checked
from kinefit._files import write_lines, write_text
from kinefit.bodies import Body, PointSet
from kinefit.exporters.opensim.model import model
from kinefit.exporters.skeletons.common import UNITS, check_up, euler_zxy, length_factor, plain_names
from kinefit.motion import Motion


@checked
def write_trc(
    motion: Motion, path: str | PathLike[str], points: PointSet | None = None, *, unit: str = "m", up: str = "y"
) -> None:
    """Write points of the fitted body over time as TRC.

    Parameters
    ----------
    motion : Motion
    path : path
    points : PointSet, optional
        By default the body's landmarks, which `write_osim` puts into the model's marker set.
    unit : "m", "cm" or "mm"
    up : str
        Vertical axis of the file's world, which the format does not state; OpenSim's is y.

    Raises
    ------
    ExportError
        Unknown unit or axis, or the file cannot be written.
    """
    factor = length_factor(unit, UNITS, path)
    points = motion.body.landmarks if points is None else points
    names = plain_names(points.names)
    check_up(up, path)
    first = round(float(motion.times[0]) * motion.rate) + 1 if len(motion) else 1  # frame 1 is at 0 s, as in C3D
    lines = trc_head(path, names, f"{motion.rate:g}", len(motion), unit, first)
    row = "\t".join(["%d", "%.9f"] + ["%.8f"] * (3 * len(names)))

    def rows() -> Iterator[str]:
        number = count(first)
        for part in motion.parts():
            values = factor * part.turned(up).positions(points).reshape(len(part), -1) + 0.0
            yield from (row % (next(number), t, *v) for t, v in zip(part.times.tolist(), values.tolist()))

    write_lines(path, chain(lines, rows()))


def trc_head(
    path: str | PathLike[str], names: Sequence[str], rate: str, count: int, unit: str, first: int = 1
) -> list[str]:
    """First lines of a TRC file of `count` frames, of which the first has the number `first`."""
    axes = "".join(f"\tX{k}\tY{k}\tZ{k}" for k in range(1, len(names) + 1))
    return [
        f"PathFileType\t4\t(X/Y/Z)\t{Path(path).name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{len(names)}\t{unit}\t{rate}\t{first}\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(names), "\t" + axes, "",
    ]  # fmt: skip


@checked
def write_mot(motion: Motion, path: str | PathLike[str]) -> None:
    """Write the angles [deg] and the root's way [m] as MOT: the coordinates of the model that `write_osim` writes."""
    tree = motion.body.tree
    names = ["time", *root_coordinates(motion.body), *plain_names(tree.coordinates)]
    lines = [motion.name.replace("\n", " "), "version=1", f"nRows={len(motion)}", f"nColumns={len(names)}"]
    lines += ["inDegrees=yes", "", "Units are S.I. units (second, meters, Newtons, ...)", "Angles are in degrees."]
    lines += ["", "endheader", "\t".join(names)]
    row = "\t".join(["%.9f"] + ["%.8f"] * (len(names) - 1))

    def rows() -> Iterator[str]:
        before = None
        for part in motion.parts():
            T = part.turned("y").Ts_world_root
            turns = euler_zxy(T[:, :3, :3], before)
            before = turns[-1] if len(turns) else None
            angles = np.where(tree.prismatic, part.angles, np.degrees(part.angles))
            table = np.concatenate([part.times[:, None], np.degrees(turns), T[:, :3, 3], angles], axis=1) + 0.0
            yield from (row % tuple(values) for values in table.tolist())

    write_lines(path, chain(lines, rows()))


@checked
def write_osim(body: Body, path: str | PathLike[str]) -> None:
    """Write a body as an OpenSim 4 model: joints, coordinates with limits, masses, landmarks as markers, cylinders.

    The masses are the usual shares of a person of 75 kg (de Leva 1996); where a segment has no share of its own, that
    of its surface filled with water. They are there so that the model can be used at once, not measured.

    Raises
    ------
    ExportError
        A joint whose axes OpenSim cannot express, or the file cannot be written.
    """
    document = ET.Element("OpenSimDocument", Version="40000")
    document.append(model(body, root_coordinates(body), path))
    ET.indent(document)
    write_text(path, '<?xml version="1.0" encoding="UTF-8" ?>\n' + ET.tostring(document, encoding="unicode") + "\n")


def root_coordinates(body: Body) -> list[str]:
    """Names of the root's six coordinates, such as pelvis_tilt, pelvis_list, pelvis_rotation, pelvis_tx, _ty, _tz."""
    root = plain_names([body.alias("opensim", body.tree.segments[0])])[0]
    return [f"{root}_{what}" for what in ("tilt", "list", "rotation", "tx", "ty", "tz")]
