"""What a 3D scene shows, as plain arrays: skin, bones, uncertainty, rays, paths, floor. Nothing here draws."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, PointSet, TaperedCylinder
from kinefit.bodies.motion import OUTLIER_WEIGHT, UP_AXES, Motion, Residuals
from kinefit.bodies.rendering.looks import RGB, Mesh, quality_ramp
from kinefit.geometry.camera import Camera

OTHERS: tuple[RGB, ...] = ((204, 121, 167), (86, 180, 233), (230, 159, 0), (120, 90, 60))
"""Colours of the second, third ... motion, which have one colour for both sides."""

OUTLIER = (255, 30, 30)
LARGEST_ELLIPSOID = 0.5  # [m] half axis beyond which "somewhere there" says nothing more, and hides the rest
_PIECES = 5  # of a bone: dashes and gaps of a lost one in turn
_JOINT = 0.016  # [m] radius of the ball at a joint, of one on thin segments less
_AROUND, _CAP = 14, 4  # vertices around a capsule, rings of a rounded end


@dataclass(frozen=True, eq=False)
class Rays:
    """Line segments: points (N, 2, 3) [m] in the world, colours (N, 2, 3) uint8 RGB."""

    points: NDArray
    colours: NDArray


def capsule(start: NDArray, end: NDArray, radii: ArrayLike, side: ArrayLike | None = None) -> Mesh:
    """Tube from `start` to `end` (3,) with rounded ends of the two radii [m].

    Ellipses have radii ((a0, b0), (a1, b1)): a along `side` (3,), which is at right angles to the axis.
    """
    given = np.asarray(radii, float)
    sections = given if given.ndim == 2 else np.repeat(given[:, None], 2, axis=1)
    first, last = np.sqrt(sections.prod(axis=1))  # along the axis
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    u = (end - start) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    across = np.cross(u, np.eye(3)[np.argmin(np.abs(u))]) if side is None else np.asarray(side, float)
    across = across / np.linalg.norm(across)
    polar = np.linspace(-np.pi / 2, 0, _CAP + 1)
    along = np.concatenate([first * np.sin(polar), length - last * np.sin(polar[::-1])])
    radius = np.concatenate([np.outer(np.cos(polar), sections[0]), np.outer(np.cos(polar[::-1]), sections[1])])
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    out = np.stack([np.outer(np.cos(angle), across), np.outer(np.sin(angle), np.cross(u, across))])  # (2, _AROUND, 3)
    vertices = start + along[:, None, None] * u + np.einsum("rk,kai->rai", radius, out)  # (rings, _AROUND, 3)
    i, j = np.meshgrid(np.arange(len(along) - 1), np.arange(_AROUND), indexing="ij")
    a, b = i * _AROUND + j, i * _AROUND + (j + 1) % _AROUND
    faces = np.stack([a, b, b + _AROUND, a, b + _AROUND, a + _AROUND], -1).reshape(-1, 3)
    return Mesh(vertices.reshape(-1, 3), faces)


def joined(meshes: Sequence[Mesh]) -> Mesh | None:
    """Several meshes as one; None of none."""
    if not meshes:
        return None
    first = np.cumsum([0] + [len(m.vertices) for m in meshes])
    faces = np.concatenate([m.faces + n for m, n in zip(meshes, first)])
    return Mesh(np.concatenate([m.vertices for m in meshes]), faces)


def bone_meshes(body: Body) -> tuple[list[Mesh | None], list[Mesh | None]]:
    """Dashes and gaps between them, thin meshes of every segment in its frame; together they are solid bones.

    Bones go to the joints of a segment's children, or to the end of the last surface.
    """
    tree, ends = body.tree, body.segment_ends()
    dashes, gaps = list[Mesh | None](), list[Mesh | None]()
    at = np.linspace(0.0, 1.0, _PIECES + 1)
    for s in range(len(tree.segments)):
        tips = [tree.offsets[k] for k in np.flatnonzero(tree.parents == s)] or ([ends[s]] if s in ends else [])
        lengths = [float(np.linalg.norm(tip)) for tip in tips]
        bones = [(tip, min(0.013, 0.1 * n)) for tip, n in zip(tips, lengths) if n > 1e-6]
        pieces = [
            [capsule(a * tip, b * tip, (radius * (1 - 0.4 * a), radius * (1 - 0.4 * b))) for a, b in pairwise(at)]
            for tip, radius in bones
        ]
        dashes.append(joined([mesh for bone in pieces for mesh in bone[::2]]))
        gaps.append(joined([mesh for bone in pieces for mesh in bone[1::2]]))
    return dashes, gaps


def joint_radii(body: Body) -> NDArray:
    """(S,) [m] of the balls at the segments' joints, inside the tapered surfaces that begin there."""
    out = np.full(len(body.tree.segments), _JOINT)
    for c in body.surfaces:
        if isinstance(c, TaperedCylinder):
            first = np.reshape(np.asarray(c.radii, float), (2, -1))[0]
            out[c.segment] = min(out[c.segment], 0.7 * float(np.prod(first) ** (1 / len(first))))
    return out


def surface_meshes(body: Body) -> list[Mesh | None]:
    """One mesh a segment, in its frame: its tapered surfaces with rounded ends, and its meshes."""
    found: list[list[Mesh]] = [[] for _ in body.tree.segments]
    for c in body.surfaces:
        if isinstance(c, TaperedCylinder):
            found[c.segment].append(capsule(np.array(c.start), np.array(c.end), c.radii, c.side))
        else:
            found[c.segment].append(Mesh(c.vertices, c.faces))
    return [joined(meshes) for meshes in found]


def ellipsoids(body: Body, joint_std: NDArray, *, sigmas: float = 2.0) -> NDArray:
    """Half axes (S, 3) [m] along the world's axes of `sigmas` standard deviations (S, 3), at most `LARGEST_ELLIPSOID`.

    A joint that does not slide is on a sphere about the one above it, so it is no farther off than that one and the
    sphere's diameter: lost fingers stay near their hand.
    """
    tree = body.tree
    out = np.minimum(sigmas * np.nan_to_num(joint_std, nan=np.inf, posinf=np.inf), LARGEST_ELLIPSOID)
    reach = 2.0 * np.linalg.norm(tree.offsets, axis=1)
    reach[tree.owners[tree.prismatic]] = LARGEST_ELLIPSOID
    for s, parent in enumerate(tree.parents):
        if parent >= 0:
            out[s] = np.minimum(out[s], out[parent] + reach[s])
    return out


def fitted_points(body: Body, residuals: Residuals) -> PointSet | None:
    """The body's points that a sensor's residuals are of: the first set that has them all on the same segments."""
    sets = body.keypoint_sets if residuals.unit == "px" else body.marker_sets
    for points in sets.values():
        if set(residuals.names) <= set(points.names):
            found = points.select(residuals.names)
            if np.array_equal(found.segments, residuals.segments):
                return found
    return None


def camera_rays(
    camera: Camera, measured: NDArray, x_world: NDArray, norms: NDArray, weights: NDArray, *, middling: float
) -> Rays:
    """Rays of one camera in one frame: from its centre through each keypoint, up to the fitted point and then to it.

    Parameters
    ----------
    measured : (K, 2) [px], in the calibration's image; NaN where unseen.
    x_world : (K, 3) [m] fitted points.
    norms, weights : (K,) [px], 0..1
        Residuals and robust weights; a point without weight is an outlier and red.
    middling : float [px]
        Residual that is drawn yellow; half of it and less is bluer, twice of it orange.
    """
    directions = camera.ray(measured)
    seen = np.flatnonzero(np.isfinite(directions).all(-1) & np.isfinite(norms))
    d, x, centre = directions[seen], np.asarray(x_world)[seen], camera.centre_world
    feet = centre + np.maximum(np.sum((x - centre) * d, axis=1), 0.1)[:, None] * d
    colours = quality_ramp(norms[seen] / (2.0 * max(middling, 1e-9)))
    colours[np.asarray(weights)[seen] < OUTLIER_WEIGHT] = OUTLIER
    points = np.concatenate([np.stack([np.broadcast_to(centre, feet.shape), feet], 1), np.stack([feet, x], 1)])
    return Rays(points, np.repeat(np.tile(colours, (2, 1))[:, None], 2, axis=1))


def floor_height(points: NDArray, up: str) -> float:
    """[m] along the vertical axis where to draw the floor under points (N, 3).

    The world's zero where the lowest point is within half a metre of it (a person may stand on a step or a beam, and a
    floor that is calibrated a little wrong should be seen to be), else the lowest point.
    """
    heights = np.asarray(points).reshape(-1, 3) @ np.array(UP_AXES[up])
    lowest = float(np.min(heights[np.isfinite(heights)], initial=np.inf))
    return 0.0 if not np.isfinite(lowest) or abs(lowest) <= 0.5 else lowest


def looked_at(cameras: Sequence[Camera]) -> NDArray:
    """(3,) [m] point nearest to the axes of all cameras; two metres ahead of them where the axes are parallel."""
    centres = np.array([c.centre_world for c in cameras])
    axes = np.array([c.T_camera_world[2, :3] for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 0.01 * len(centres):  # about 6 degrees between two axes
        return np.mean(centres + 2.0 * axes, axis=0)
    return np.linalg.solve(total, np.einsum("cij,cj->i", across, centres))


def angle_line(motion: Motion, coordinate: str, frame: int) -> str:
    """Words for one coordinate in one frame, with twice its standard deviation: "knee_angle_r 34.2° ± 3.1°"."""
    values, spreads, unit = angle_course(motion, coordinate)
    digits = 1 if unit == "°" else 0
    spread = f"± {spreads[frame]:.{digits}f}{unit}" if np.isfinite(spreads[frame]) else "(not observed)"
    return f"{coordinate} {values[frame]:.{digits}f}{unit} {spread}"


def angle_course(motion: Motion, coordinate: str) -> tuple[NDArray, NDArray, str]:
    """(F,) values and twice their standard deviations of a coordinate in "°", of a sliding one in " mm"."""
    d = motion.body.tree.coordinates.index(coordinate)
    scale, unit = (1000.0, " mm") if motion.body.tree.prismatic[d] else (180 / np.pi, "°")
    return scale * motion.angles[:, d], 2 * scale * motion.dof_std[:, 6 + d], unit


def as_markdown(name: str) -> str:
    """Markdown that shows a name of a file as it is: without elements, links, images, code and emphasis of its own."""
    return re.sub(r"([\\`*\[\]()<>!&#|~])", r"\\\1", name)
