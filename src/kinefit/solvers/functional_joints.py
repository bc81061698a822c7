"""Functional joint centres and axes: where two segments are seen to turn about each other, with no body assumed.

Balls: Ehrig, Taylor, Duda, Heller, A survey of formal methods for determining the centre of rotation of ball joints,
J Biomech 39 (2006), the symmetrical centre (SCoRE) where both segments have three markers, the geometric sphere fit
where one has fewer. Hinges: the axis of both segments of the same authors' survey of 2007 (SARA), by the singular
vectors of the mean relative rotation. `tracking.marker_subject` calibrates all joints of a body at once and knows
proportions and landmarks besides; these tell what one joint's movement says by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import bare, matched
from kinefit.errors import ObservationError, choices
from kinefit.observations import Markers
from kinefit.solvers.rigid_clusters import local, middle, rigid_frames, shape_of

LEAST_TURN = np.deg2rad(8.0)
"""[rad] standard deviation of a turn that tells a centre. Skin leaves a segment's pose some 3 mm off at the joint, so
the centre by 3 mm over the turn, here 2 cm. In jumps and walks, whose hips turn by 4 to 5 degrees about their second
axis, centres were 28 to 61 mm from the laboratory's; what all joints together tell was 8 to 18 mm from it."""

_FEWEST = 10  # frames
_STARTS = 30  # of a sphere fit: one of them without outliers, where a tenth of the frames has some
_OUTLYING, _REFITS = 4.0, 3  # times the typical distance beyond which a frame is left out, and how often that is done


@dataclass(frozen=True, eq=False)
class FunctionalJoint:
    """Where two segments meet.

    Parameters
    ----------
    centre : (F, 3) [m] in the world; of a hinge the point of its axis that is nearest to the child's markers. NaN in
        frames that do not show both segments.
    axis : (F, 3) unit, of a hinge, in the world; None for a ball.
    spread : float [m] root mean square distance of the two places that the segments give the joint.
    turns : (3,) [rad] standard deviations of the child's turns in the parent about three axes at right angles, largest
        first. Errors of a centre are those of the segments' poses divided by the second of them (hinge: the first).
    """

    centre: NDArray
    axis: NDArray | None
    spread: float
    turns: NDArray


@checked
def functional_centre(markers: Markers, parent: Sequence[str], child: Sequence[str]) -> FunctionalJoint:
    """Centre of a ball joint, such as a hip, from a take in which it moves about more than one axis.

    Parameters
    ----------
    parent : labels of three markers of one segment at least.
    child : labels of the other's; with one or two the joint is the middle of the spheres on which they move.

    Raises
    ------
    ObservationError
        Unknown labels, too few markers or frames, or a joint that was held still or turned about one axis only.
    """
    y, x = _columns(markers, parent, 3), _columns(markers, child, 1)
    Rp, tp = _poses(y)
    if x.shape[1] < 3:
        a, spread, turns = _sphere(local(Rp, tp, x))
        return FunctionalJoint(Rp @ a + tp, None, spread, turns)
    Rc, tc = _poses(x)
    good = _both(tp, tc)
    turns = _turns(Rp[good], Rc[good])
    if turns[1] < LEAST_TURN:
        raise _held(turns, "about two axes", 1)
    for _ in range(_REFITS):
        A = np.concatenate([Rp[good], -Rc[good]], axis=2).reshape(-1, 6)
        c = np.linalg.lstsq(A, (tc[good] - tp[good]).ravel(), rcond=None)[0]
        off = np.linalg.norm((Rp @ c[:3] + tp) - (Rc @ c[3:] + tc), axis=1)
        good = _inliers(off, good)
    spread = float(np.sqrt(np.mean(off[good] ** 2)))
    return FunctionalJoint(0.5 * (Rp @ c[:3] + tp + Rc @ c[3:] + tc), None, spread, turns)


@checked
def functional_axis(markers: Markers, parent: Sequence[str], child: Sequence[str]) -> FunctionalJoint:
    """Axis of a hinge, such as a knee, from a take in which it bends.

    Parameters
    ----------
    parent, child : labels of three markers of each segment at least.

    Raises
    ------
    ObservationError
        Unknown labels, too few markers or frames, or a joint that was held still.
    """
    y, x = _columns(markers, parent, 3), _columns(markers, child, 3)
    (Rp, tp), (Rc, tc) = _poses(y), _poses(x)
    good = _both(tp, tc)
    turns = _turns(Rp[good], Rc[good])
    if turns[0] < LEAST_TURN:
        raise _held(turns, "about its axis", 0)
    for _ in range(_REFITS):
        U, _, Vt = np.linalg.svd(np.einsum("fji,fjk->ik", Rp[good], Rc[good]))
        u, v = U[:, 0], Vt[0]  # unit vectors that minimise Σ |R_p u − R_c v|²
        amid = middle(local(Rc[good], tc[good], x[good]), axis=(0, 1))  # of the child's markers
        given = np.concatenate([_seen_from(Rp[good], tp[good], Rc[good] @ amid + tc[good]), amid])
        A = np.concatenate([Rp[good], -Rc[good]], axis=2).reshape(-1, 6)
        across = np.linalg.svd(np.concatenate([u, v])[None])[2][1:].T  # (6, 5): both may slide along the axis together
        left = (tc[good] - tp[good]).ravel() - A @ given
        c = given + across @ np.linalg.lstsq(A @ across, left, rcond=None)[0]
        off = np.linalg.norm((Rp @ c[:3] + tp) - (Rc @ c[3:] + tc), axis=1)
        good = _inliers(off, good)
    axis = Rp @ u + Rc @ v
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    spread = float(np.sqrt(np.mean(off[good] ** 2)))
    return FunctionalJoint(0.5 * (Rp @ c[:3] + tp + Rc @ c[3:] + tc), axis, spread, turns)


def sphere_centre(x: NDArray) -> tuple[NDArray, NDArray, float]:
    """Centre (3,), radii (K,) [m] and RMS misfit of the spheres about one centre on which points (F, K, 3) move.

    Least squares of the distances from the spheres (Gauss-Newton), which small arcs do not draw inwards, from the
    algebraic fit of Gamage and Lasenby, J Biomech 35 (2002). NaN is not seen.
    """
    origin = np.nanmean(x, axis=(0, 1))
    d, seen = x - origin, np.isfinite(x).all(axis=2)
    square = np.einsum("fki,fki->fk", d, d)
    A, b = 2.0 * (d - np.nanmean(d, axis=0)), square - np.nanmean(square, axis=0)
    c = origin + np.linalg.lstsq(A[seen], b[seen], rcond=1e-9)[0]
    for _ in range(50):
        away = x - c
        length = np.linalg.norm(away, axis=2)
        r = length - np.nanmean(length, axis=0)
        J = away / length[..., None]
        J = J - np.nanmean(J, axis=0)
        step = np.linalg.lstsq(J[seen], r[seen], rcond=1e-9)[0]
        c = c + step
        if np.linalg.norm(step) < 1e-9:
            break
    length = np.linalg.norm(x - c, axis=2)
    radii = np.nanmean(length, axis=0)
    return c, radii, float(np.sqrt(np.nanmean((length - radii) ** 2)))


def _sphere(x: NDArray) -> tuple[NDArray, float, NDArray]:
    """Centre in the parent's frame, misfit and turns of a child of one or two markers (F, k, 3) seen in that frame."""
    good = np.isfinite(x).all(axis=2).any(axis=1)
    if good.sum() < _FEWEST:
        raise _few(int(good.sum()))
    rng, frames, least = np.random.default_rng(0), np.flatnonzero(good), np.inf
    for _ in range(_STARTS):  # the least median of squares, which up to half of the frames do not draw
        c, radii, _ = sphere_centre(x[rng.choice(frames, min(len(frames), 2 * _FEWEST), replace=False)])
        off = middle(np.abs(np.linalg.norm(x - c, axis=2) - radii), axis=1)
        if (typical := float(np.nanmedian(off[frames]))) < least:
            least, good = typical, _inliers(off, good)
    for _ in range(_REFITS):
        c, radii, misfit = sphere_centre(x[good])
        off = middle(np.abs(np.linalg.norm(x - c, axis=2) - radii), axis=1)
        good = _inliers(off, good)
    directions = (x[good] - c) / radii[:, None]
    J = (directions - np.nanmean(directions, axis=0)).reshape(-1, 3)
    seen = np.isfinite(J).all(axis=1)
    turns = np.sqrt(np.linalg.eigvalsh(J[seen].T @ J[seen] / seen.sum()))[::-1]
    if turns[1] < LEAST_TURN:
        raise _held(turns, "about two axes", 1)
    return c, misfit, turns


def _columns(markers: Markers, labels: Sequence[str], least: int) -> NDArray:
    """(F, k, 3) [m] of the named markers."""
    names = [bare(n) for n in markers.names]
    meant = [n if n in markers.names else m for n, m in zip(labels, matched(labels, names))]
    for label, name in zip(labels, meant):
        if name is None:
            problem = choices("marker", label, markers.names)
            raise ObservationError(problem, file=markers.source or None, remedy="Give labels of the take.")
    if len(set(labels)) < max(least, len(labels)):
        raise ObservationError(
            f"{len(set(labels))} markers of a segment: {', '.join(labels)}", remedy=f"Give {least} at least, each once."
        )
    where = [markers.names.index(n) if n in markers.names else names.index(str(n)) for n in meant]
    return np.asarray(markers.positions)[:, where]


def _poses(y: NDArray) -> tuple[NDArray, NDArray]:
    """Rotations and translations of a cluster (F, k, 3); NaN in frames that show fewer than three of its markers."""
    if not (np.isfinite(y[..., 0]).sum(1) >= 3).any():
        raise _few(0)
    shape = shape_of(y)
    R, t = rigid_frames(shape, y, rigid_frames(shape, y)[0])  # its own prior, which so pulls nothing
    few = np.isfinite(y[..., 0]).sum(1) < 3
    R[few], t[few] = np.nan, np.nan
    return R, t


def _both(tp: NDArray, tc: NDArray) -> NDArray:
    good = np.isfinite(tp).all(axis=1) & np.isfinite(tc).all(axis=1)
    if good.sum() < _FEWEST:
        raise _few(int(good.sum()))
    return np.asarray(good)


def _turns(Rp: NDArray, Rc: NDArray) -> NDArray:
    """(3,) [rad] how far the child turns in the parent, largest first: of axes, as unit vectors that spread.

    The mean relative rotation M has singular values that are mean cosines of turns; two of three angles move each.
    """
    relative = np.einsum("fji,fjk->fik", Rp, Rc)
    s = np.clip(np.linalg.svd(relative.mean(0), compute_uv=False), -1.0, 1.0)
    loss = 2.0 * (1.0 - s)  # of each axis: the sum of the variances of turns about the other two
    variances = 0.5 * loss.sum() - loss
    return np.sqrt(np.clip(np.sort(variances)[::-1], 0.0, None))


def _seen_from(R: NDArray, t: NDArray, x: NDArray) -> NDArray:
    """Median place (3,) of world points (F, 3) in a frame."""
    return np.asarray(np.median(np.einsum("fji,fj->fi", R, x - t), axis=0))


def _inliers(off: NDArray, before: NDArray) -> NDArray:
    """Frames whose misfit is no outlier; those of before where hardly any would be left."""
    typical = float(np.nanmedian(off[before]))
    good = np.nan_to_num(off, nan=np.inf) < max(_OUTLYING * typical, 1e-6)
    return np.asarray(good if good.sum() >= _FEWEST else before)


def _few(frames: int) -> ObservationError:
    return ObservationError(
        f"{frames} frames show enough markers of both segments", remedy=f"{_FEWEST} frames are the least."
    )


def _held(turns: NDArray, about: str, which: int) -> ObservationError:
    return ObservationError(
        f"the joint turns {about} by {np.degrees(turns[which]):.1f} deg (standard deviation), too little to tell it",
        remedy="Record it moving through its range: a hip swung forwards, outwards and round, a knee bent.",
    )
