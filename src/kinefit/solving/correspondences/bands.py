"""Elastic bands that connect the parts of a body at its joints (P2 3.4, fig. 2)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet, TaperedCylinder
from kinefit.bodies.tree import Closure
from kinefit.errors import BodyError, ObservationError, check_choice
from kinefit.solving.correspondences import targets
from kinefit.solving.rows import PairRows

_DEFAULT_HALF_WIDTH = 0.05  # [m] of a joint between parts without cylinders: that of an elbow

BAND = "band "
"""How names of the closures and landmarks of `with_bands` begin."""


@dataclass(frozen=True, eq=False)
class Bands:
    """Pairs of points that K elastic bands pull together.

    Parameters
    ----------
    parent, child : PointSet of K points each, on both parts of a joint; they coincide at rest.
    joint : (K,) int, segment whose joint each band belongs to.
    """

    parent: PointSet
    child: PointSet
    joint: NDArray

    def __len__(self) -> int:
        return len(self.joint)


def universal_band(centre: ArrayLike) -> NDArray:
    """One band (1, 3) [m] at a joint's centre (3,): three rotations are free, such as a shoulder's (P2 fig. 2a)."""
    return np.asarray(centre, float).reshape(1, 3)


def hinge_bands(centre: ArrayLike, axis: ArrayLike, half_width: float, count: int = 2) -> NDArray:
    """Bands (K, 3) [m], K = count, evenly along a line: the rotation about it is free, as of an elbow (P2 fig. 2b)."""
    direction = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.asarray(centre, float) + half_width * np.linspace(-1.0, 1.0, count)[:, None] * direction


def elliptic_bands(centre: ArrayLike, half_axes: ArrayLike, count: int = 4) -> NDArray:
    """Bands (K, 3) [m], K = count, on an ellipse with half axes (2, 3) [m]: no free rotation, as of a neck (2c)."""
    a, b = np.asarray(half_axes, float)
    turn = 2 * np.pi * np.arange(count)[:, None] / count
    return np.asarray(centre, float) + np.cos(turn) * a + np.sin(turn) * b


def joint_bands(
    body: Body, *, elliptic: Collection[str] = ("neck",), along_line: int = 2, along_ellipse: int = 4,
    joints: Collection[str] | None = None,
) -> Bands:
    """Bands of joints of a body: a fixed joint becomes elliptic, a revolute one a hinge, all others universal.

    Parameters
    ----------
    body : Body
        With its joints; `free_parts(body)` has the same bands, because segments keep their indices.
    elliptic : names of joints with three axes but a small range, which become elliptic too; unknown names are ignored.
    along_line, along_ellipse : int
        Number of bands of a hinge and of an elliptic joint.
    joints : names of the joints that get bands; default: all.

    Raises
    ------
    BodyError
        A sliding joint, fewer than two bands of a hinge, or than three of an ellipse.
    """
    if along_line < 2 or along_ellipse < 3:
        problem = f"{along_line} bands of a hinge and {along_ellipse} of an elliptic joint"
        raise BodyError(problem, remedy="Give two or more, and three or more.")
    tree = body.tree
    points, owners = [], []
    for s in range(1, len(tree.segments)):
        if joints is not None and body.joints[s] not in joints:
            continue
        turns = tree.axes[tree.dof_start[s] : tree.dof_start[s + 1]]
        if tree.prismatic[tree.dof_start[s] : tree.dof_start[s + 1]].any():
            raise BodyError("bands cannot have a sliding joint", place=body.joints[s], remedy="Give rotating joints.")
        if len(turns) == 0 or body.joints[s] in elliptic:
            bands = elliptic_bands(np.zeros(3), _section(body, s), along_ellipse)
        elif len(turns) == 1:
            width = float(np.linalg.norm(_section(body, s), axis=1).mean())
            bands = hinge_bands(np.zeros(3), turns[0], width, along_line)
        else:
            bands = universal_band(np.zeros(3))
        points.append(bands)
        owners.append(np.full(len(bands), s))
    x, joint = (np.concatenate(v) if v else v for v in (points, owners))
    joint = np.asarray(joint, np.int64)
    names = tuple(f"{tree.segments[s]}_{k}" for k, s in enumerate(joint))
    x = np.asarray(x, float).reshape(-1, 3)
    parent = PointSet(names, tree.parents[joint], x + tree.offsets[joint])
    return Bands(parent, PointSet(names, joint, x), joint)


def band_rows(body: Body, state: BodyState, bands: Bands, *, sigma: ArrayLike = 0.005) -> PairRows:
    """Three pair rows for each band: the points of both parts should coincide (P2 4.2.6).

    Parameters
    ----------
    body : Body
        Of free parts (`bodies.parts.free_parts`); in an ordinary body the bands are never stretched.
    state : BodyState
    bands : Bands
    sigma : scalar or (K,) [m]
        Standard deviation of a band's extension.
    """
    return coincidence_rows(body, state, bands.parent, bands.child, sigma=sigma)


def with_bands(body: Body, sigmas: Mapping[str, float]) -> Body:
    """Replace joints of a body by elastic bands, see `joint_bands`: free joints, and soft closures between band ends.

    The joint keeps its coordinates with their names and limits. It gets three slides, and the rotations that it lacks,
    which only its bands constrain.

    Parameters
    ----------
    sigmas : {name of a joint: standard deviation [m] of the extension of each of its bands}; "all" stands for every
        joint that is not named and does not slide. A band's weight is 1 / sigma².

    Raises
    ------
    BodyError
        An unknown joint, or one that slides.
    """
    tree, closures = body.tree, list(body.closures)
    sliding = {body.joints[s] for s in tree.owners[tree.prismatic].tolist()}
    sigma = {joint: sigmas["all"] for joint in body.joints[1:] if joint not in sliding} if "all" in sigmas else {}
    for joint in sigmas.keys() - {"all"}:
        check_choice("joint", joint, body.joints[1:], BodyError, remedy='Name one of these, or "all".')
        sigma[joint] = sigmas[joint]
    bands = joint_bands(body, joints=sigma)
    names = [f"{BAND}{name}" for name in bands.child.names]
    for name, joint in zip(names, bands.joint):
        closures.append(Closure(name, "point", f"{name} outer", f"{name} inner", sigma=sigma[body.joints[joint]]))
    landmarks = PointSet(
        (*body.landmarks.names, *(f"{name} outer" for name in names), *(f"{name} inner" for name in names)),
        np.concatenate([body.landmarks.segments, bands.child.segments, bands.parent.segments]),
        np.concatenate([body.landmarks.points, bands.child.points, bands.parent.points]),
    )
    for s in np.unique(bands.joint).tolist():
        own = tree.axes[tree.dof_start[s] : tree.dof_start[s + 1]]
        tree = _freed(tree, s, np.linalg.svd(own)[2][np.linalg.matrix_rank(own) :] if len(own) else np.eye(3))
    return replace(body, tree=tree, landmarks=landmarks, closures=tuple(closures))


def _freed(tree: KinematicTree, segment: int, turns: NDArray) -> KinematicTree:
    """The tree with three slides before a joint's coordinates, and rotations about further axes (k, 3) after them."""
    first, stop = int(tree.dof_start[segment]), int(tree.dof_start[segment + 1])
    at = np.repeat([first, stop], [3, len(turns)])
    names, k = list(tree.coordinates), len(at)
    names[stop:stop] = [f"{tree.segments[segment]}_band_r{i + 1}" for i in range(len(turns))]
    names[first:first] = [f"{tree.segments[segment]}_band_t{axis}" for axis in "xyz"]
    added = {
        "axes": np.concatenate([np.eye(3), turns]), "prismatic": np.arange(k) < 3, "lower": np.full(k, -np.inf),
        "upper": np.full(k, np.inf), "usual": np.zeros(k), "spread": np.full(k, np.inf),
    }  # fmt: skip
    columns = {name: np.insert(getattr(tree, name), at, values, axis=0) for name, values in added.items()}
    return replace(
        tree, coordinates=tuple(names), owners=np.insert(tree.owners, at, segment),
        couplings=np.insert(tree.couplings, at, 0.0, axis=1), **columns,
    )  # fmt: skip


def _section(body: Body, segment: int) -> NDArray:
    """Half axes (2, 3) [m] of the cross-section of a part at its joint."""
    own = [c for c in body.surfaces if isinstance(c, TaperedCylinder) and c.segment == segment]
    if not own:
        return _DEFAULT_HALF_WIDTH * np.eye(3)[[0, 2]]
    nearest = min(own, key=lambda c: float(np.linalg.norm(c.start)))
    return nearest.axes[:2] * np.array(nearest.radii[0])[:, None]


def coincidence_rows(
    body: Body, state: BodyState, points_a: PointSet, points_b: PointSet, *, sigma: ArrayLike = 0.001
) -> PairRows:
    """Three pair rows for each pair of points that should coincide: r = x_b − x_a along the world's axes.

    Parameters
    ----------
    points_a, points_b : PointSet of K points each, on different segments.
    sigma : scalar or (K,) [m]
        Standard deviation of the gap; a small one makes a closed chain.

    Raises
    ------
    ObservationError
        Different numbers of points, or a sigma that is not positive.
    """
    if len(points_a) != len(points_b):
        problem = f"{len(points_a)} points should meet {len(points_b)}"
        raise ObservationError(problem, remedy="Give equal numbers of points.")
    a, b = body.positions(state, points_a), body.positions(state, points_b)
    n = np.tile(np.eye(3), (len(a), 1))
    w = np.repeat(targets.weights(sigma, np.ones(len(a), bool), "coincidences"), 3)
    pairs = np.repeat(np.stack([points_a.segments, points_b.segments], axis=1), 3, axis=0)
    gap = (b - a).reshape(-1)
    return PairRows(pairs, np.repeat(a, 3, axis=0), np.repeat(b, 3, axis=0), n, gap, w)
