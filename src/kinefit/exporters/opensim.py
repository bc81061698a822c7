"""OpenSim: landmarks over time (.trc), angles over time (.mot) and the fitted body as a model (.osim).

All three stand in OpenSim's world, y up (TRC by default). The root's coordinates are those of OpenSim's
ground_pelvis joint: the way of its origin, then turns about its own z (tilt), x (list) and y (rotation).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, count
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit._files import write_lines, write_text
from kinefit.bodies import Body, PointSet
from kinefit.bodies.masses import rod, segment_masses
from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces import Surface
from kinefit.errors import ExportError
from kinefit.exporters.skeletons.common import UNITS, check_up, euler, euler_zxy, length_factor, numbers, plain_names
from kinefit.geometry.lines import perpendiculars

_DENSITY_KG_M3, _MIN_MASS_KG = 1000.0, 0.01  # [kg/m³], [kg]
_EYE, _ZERO = np.eye(3), "0 0 0"


def model(body: Body, root_coordinates: list[str], path: str | PathLike[str]) -> ET.Element:
    """The element <Model>; `root_coordinates`: names of the turns z, x, y and the three ways; `path` for messages.

    Raises ExportError for a joint of more than three turns or three ways.
    """
    tree, found = body.tree, segment_masses(body)
    names = plain_names(body.alias("opensim", s) for s in tree.segments)
    coordinates = plain_names(tree.coordinates)
    out = ET.Element("Model", name=plain_names([body.name])[0])
    _texts(out, length_units="meters", force_units="N", gravity="0 -9.80665 0")
    bodies = ET.SubElement(ET.SubElement(out, "BodySet"), "objects")
    joints = ET.SubElement(ET.SubElement(out, "JointSet"), "objects")
    markers = ET.SubElement(ET.SubElement(out, "MarkerSet"), "objects")
    for s, name in enumerate(names):
        mass, centre = (float(found.masses[s]), found.centres[s]) if found.masses[s] > 0.0 else (0.0, None)
        bodies.append(_body(name, [c for c in body.surfaces if c.segment == s], mass, centre))
        parent = "/ground" if tree.parents[s] < 0 else f"/bodyset/{names[tree.parents[s]]}"
        dofs = range(tree.dof_start[s], tree.dof_start[s + 1])
        moves = {d: (coordinates[d], tree.axes[d], _limits(tree.lower[d], tree.upper[d])) for d in dofs}
        turns = [move for d, move in moves.items() if not tree.prismatic[d]]
        ways = [move for d, move in moves.items() if tree.prismatic[d]]
        if tree.parents[s] < 0:
            turns = [(c, _EYE[k], (-2 * np.pi, 2 * np.pi)) for c, k in zip(root_coordinates[:3], (2, 0, 1))] + turns
            ways = [(c, _EYE[k], (-100.0, 100.0)) for c, k in zip(root_coordinates[3:], (0, 1, 2))] + ways
        if len(turns) > 3 or len(ways) > 3:
            place = f"joint {body.joints[s]}"
            raise ExportError("OpenSim has no joint of more than three turns or three ways", file=path, place=place)
        joints.append(_joint(plain_names([body.joints[s]])[0], parent, name, tree.offsets[s], turns, ways, path))
    points = body.landmarks
    for label, s, at in zip(plain_names(points.names), points.segments, points.points):
        marker = ET.SubElement(markers, "Marker", name=label)
        _texts(marker, socket_parent_frame=f"/bodyset/{names[s]}", location=at, fixed="true")
    return out


def _joint(
    name: str, parent: str, child: str, at: NDArray, turns: list, ways: list, path: str | PathLike[str]
) -> ET.Element:
    joint = ET.Element("CustomJoint" if turns or ways else "WeldJoint", name=name)
    _texts(joint, socket_parent_frame=f"{name}_parent", socket_child_frame=f"{name}_child")
    if turns or ways:
        coordinates = ET.SubElement(joint, "coordinates")
        for coordinate, _, (low, high) in turns + ways:
            entry = ET.SubElement(coordinates, "Coordinate", name=coordinate)
            _texts(entry, default_value=np.clip(0.0, low, high), range=[low, high], clamped="false", locked="false")
    frames = ET.SubElement(joint, "frames")
    for frame, socket, offset in ((f"{name}_parent", parent, at), (f"{name}_child", f"/bodyset/{child}", np.zeros(3))):
        entry = ET.SubElement(frames, "PhysicalOffsetFrame", name=frame)
        _texts(entry, socket_parent=socket, translation=offset, orientation=_ZERO)
    if turns or ways:
        transform = ET.SubElement(joint, "SpatialTransform")
        for kind, moves in (("rotation", turns), ("translation", ways)):
            axes = _three_axes([axis for _, axis, _ in moves])
            if abs(np.linalg.det(axes)) < 1e-3:
                raise ExportError(
                    "OpenSim needs axes that do not lie in one plane",
                    file=path, place=f"joint {name}", remedy="Turn one of the axes, or remove one.",
                )  # fmt: skip
            for k in range(3):
                _transform_axis(transform, f"{kind}{k + 1}", axes[k], moves[k][0] if k < len(moves) else None)
    return joint


def _three_axes(axes: Sequence[NDArray]) -> NDArray:
    """(3, 3) the axes, made up to three by directions at right angles to them."""
    if not axes:
        return _EYE
    if len(axes) == 2:
        normal = np.cross(axes[0], axes[1])
        return np.array([*axes, normal / max(float(np.linalg.norm(normal)), 1e-12)])
    return np.array(axes if len(axes) == 3 else [*axes, *perpendiculars(axes[0])])


def _transform_axis(transform: ET.Element, name: str, axis: NDArray, coordinate: str | None) -> None:
    entry = ET.SubElement(transform, "TransformAxis", name=name)
    _texts(entry, coordinates=coordinate or "", axis=axis)
    if coordinate:
        _texts(ET.SubElement(entry, "LinearFunction", name="function"), coefficients="1 0")
    else:
        _texts(ET.SubElement(entry, "Constant", name="function"), value="0")


def _limits(low: float, high: float) -> tuple[float, float]:
    return max(float(low), -99999.9), min(float(high), 99999.9)


def _body(name: str, surfaces: Sequence[Surface], mass: float, centre: NDArray | None) -> ET.Element:
    mass, centre, inertia = mass_properties(surfaces, mass, centre)
    out = ET.Element("Body", name=name)
    _texts(
        out, mass=mass, mass_center=centre,
        inertia=[inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))],
    )  # fmt: skip
    components = ET.SubElement(out, "components") if surfaces else out
    for k, surface in enumerate(surfaces):
        middle, R_body_cylinder, length, radii = rod(surface)
        label = f"{name}_{k + 1}" if k else name
        frame = ET.SubElement(components, "PhysicalOffsetFrame", name=f"{label}_axis")
        geometry = ET.SubElement(ET.SubElement(frame, "attached_geometry"), "Cylinder", name=f"{label}_surface")
        radius = float(np.mean(radii))
        _texts(geometry, radius=radius, half_height=0.5 * length)
        if abs(radii[0] - radii[1]) > 1e-9:
            _texts(geometry, scale_factors=[radii[0] / radius, 1.0, radii[1] / radius])
        _texts(frame, socket_parent="..", translation=middle, orientation=euler(R_body_cylinder[None], "xyz"))
    return out


def mass_properties(
    surfaces: Sequence[Surface], mass: float = 0.0, centre: NDArray | None = None
) -> tuple[float, NDArray, NDArray]:
    """Mass [kg], centre of mass (3,) [m] and inertia (3, 3) [kg m²] about it, of elliptical rods along the surfaces.

    Without a mass (of gear) they are filled with water; the centre is that of the rods where it is not given.
    """
    rods = [rod(surface) for surface in surfaces] or [(np.array([0.0, 0.025, 0.0]), _EYE, 0.05, np.full(2, 0.02))]
    volumes = np.array([np.pi * length * radii[0] * radii[1] for _, _, length, radii in rods])
    mass = max(_MIN_MASS_KG, mass or _DENSITY_KG_M3 * float(volumes.sum()))
    masses = mass * volumes / volumes.sum()
    middle_of_rods = sum(m * middle for m, (middle, _, _, _) in zip(masses, rods)) / mass
    inertia = np.zeros((3, 3))
    for m, (middle, R, length, (a, b)) in zip(masses, rods):
        own = m * np.diag([b**2 / 4 + length**2 / 12, (a**2 + b**2) / 4, a**2 / 4 + length**2 / 12])
        away = middle - middle_of_rods
        inertia += R @ own @ R.T + m * ((away @ away) * _EYE - np.outer(away, away))
    return mass, middle_of_rods if centre is None else centre, inertia


def _texts(parent: ET.Element, **texts: str | ArrayLike) -> None:
    """Elements with a text or numbers, in this order."""
    for tag, text in texts.items():
        ET.SubElement(parent, tag).text = text if isinstance(text, str) else numbers(text, ".10g")


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
def write_forces(motion: Motion, path: str | PathLike[str]) -> None:
    """Write what force plates measured as ground forces of OpenSim, y up: `ground_force_1_vx` and so on.

    Force [N], centre of pressure [m] and free moment [N m] of each plate, zero below 20 N, at the
    highest rate of the plates.

    Raises
    ------
    ExportError
        No plate was recorded, or the file cannot be written.
    """
    if not motion.plates:
        remedy = "Name the C3D of the trial in [[markers]], or its forces in [[plate]]."
        raise ExportError("this motion has no force plates", file=path, remedy=remedy)
    upright = replace(next(motion.parts(1)), plates=motion.plates).turned("y").plates
    rate, first = max(plate.rate for plate in upright), min(plate.first_time for plate in upright)
    last = max(float(plate.times[-1]) for plate in upright)
    times = first + np.arange(round((last - first) * rate) + 1) / rate
    names, columns = ["time"], [times]
    for k, plate in enumerate((plate.at(times) for plate in upright), 1):
        names += [f"ground_force_{k}_{kind}{axis}" for kind in "vp" for axis in "xyz"]
        names += [f"ground_torque_{k}_{axis}" for axis in "xyz"]
        at, turning = plate.centre_of_pressure(), plate.free_moment()[:, None] * plate.normal
        table = np.concatenate([np.where(np.isfinite(at), plate.force, 0.0), at, turning], axis=1)
        columns += list(np.nan_to_num(table).T)
    head = [motion.name.replace("\n", " "), "version=1", f"nRows={len(times)}", f"nColumns={len(names)}"]
    head += ["inDegrees=yes", "endheader", "\t".join(names)]
    row = "\t".join(["%.9f"] + ["%.6f"] * (len(names) - 1))
    write_lines(path, chain(head, (row % tuple(values) for values in (np.column_stack(columns) + 0.0).tolist())))


@checked
def write_osim(body: Body, path: str | PathLike[str]) -> None:
    """Write a body as an OpenSim 4 model: joints, coordinates with limits, masses, landmarks as markers, cylinders.

    Masses and their centres are those of `bodies.masses.segment_masses`: shares by de Leva (1996) of `Body.mass`, or of
    the mean mass of people of this stature. Gear is filled with water. Inertias are those of rods along the surfaces.

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
