"""Functional joint centres and axes: estimated from the relative motion of two segments, without a body model.

Balls: Ehrig, Taylor, Duda, Heller, A survey of formal methods for determining the centre of rotation of ball joints,
J Biomech 39 (2006), the symmetrical centre (SCoRE) if both segments have three markers, the geometric sphere fit if
one has fewer. Hinges: the axis of both segments of the same authors' survey of 2007 (SARA), by the singular vectors of
the mean relative rotation. `markers.subject` calibrates all joints of a body jointly, with proportions and
landmarks; these functions use one joint's motion alone.

Rigid clusters: the mean shape of markers and its pose in every frame, and motions of limbs from pairs of points.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape, checked
from kinefit.bodies.marker_sets import bare, matched
from kinefit.errors import ObservationError, choices
from kinefit.geometry.se3 import nearest_rotation
from kinefit.observations import Markers


def nan_median(values: NDArray, axis: int | tuple[int, ...]) -> NDArray:
    """Median along an axis, without NaN; NaN, with no warning, if all are NaN."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        median = np.nanmedian if np.isnan(values).any() else np.median  # the same, several times as fast
        return np.asarray(median(values, axis=axis))


def rigid_frames(
    x: NDArray, y: NDArray, prior: NDArray | None = None, weight: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Rotations (F, 3, 3) and translations (F, 3) that map x onto y by least squares; NaN in frames without points.

    Parameters
    ----------
    x : (k, 3) or (F, k, 3) [m] points of the cluster
    y : (F, k, 3) [m] measured points, NaN for missing ones
    prior : (F, 3, 3) rotations that decide what one or two points leave undetermined; default: the identity
    weight : (k,) or (F, k) of the points; default: 1
    """
    prior = np.broadcast_to(np.eye(3), (len(y), 3, 3)) if prior is None else prior
    measured = np.isfinite(y[..., 0])
    share = np.where(measured, 1.0 if weight is None else weight / weight.max(), 0.0)[..., None]
    count = np.maximum(share.sum(1), 1e-300)
    x_all = np.where(measured[..., None], x, 0.0)
    y_all = np.where(measured[..., None], y, 0.0)
    x_mid, y_mid = (share * x_all).sum(1) / count, (share * y_all).sum(1) / count
    a = np.where(measured[..., None], x - x_mid[:, None], 0.0)
    b = np.where(measured[..., None], y_all - y_mid[:, None], 0.0)
    size = (share * a * a).sum((1, 2))[:, None, None]
    cross = np.einsum("fki,fkj->fij", share * b, a)
    cross += (1e-4 * size + 1e-12) * np.where(np.isfinite(prior), prior, np.eye(3))
    R = nearest_rotation(cross)
    t = y_mid - np.einsum("fij,fj->fi", R, x_mid)
    missing = ~measured.any(1)
    R[missing], t[missing] = np.nan, np.nan
    return R, t


def local(R: NDArray, t: NDArray, y: NDArray) -> NDArray:
    """(F, k, 3) [m] world points y in the frames of a segment with rotations (F, 3, 3) and origins (F, 3)."""
    return np.einsum("fji,fkj->fki", R, y - t[:, None])


def shape_of(y: NDArray) -> NDArray:
    """(k, 3) [m] mean shape of a rigid cluster y (F, k, 3), in the pose of the frame with the most markers."""
    shape = y[int(np.argmax(np.isfinite(y[..., 0]).sum(1)))]
    shape = np.where(np.isfinite(shape), shape, np.nanmean(shape, axis=0))
    for _ in range(3):
        typical = nan_median(local(*rigid_frames(shape, y), y), axis=0)
        shape = np.where(np.isfinite(typical), typical, shape)
    return shape


def absolute_orientation(
    source: NDArray, target: NDArray, weight: NDArray, limb: NDArray, count: int, *, stay: float = 0.0
) -> tuple[NDArray, NDArray]:
    """The rigid motion x -> R x + t of each limb that minimises Σ w |R source + t − target|² over its pairs.

    The rotation is the one nearest to Σ w b aᵀ, a and b being source and target about their weighted means (Horn,
    JOSA A 4, 1987; Kabsch 1978; P2 4.2.7). Pairs that do not determine it (one pair, or all on a line) have several:
    a quarter of `stay`, added to the diagonal, prefers the identity.

    Parameters
    ----------
    source, target : (N, 3) [m] pairs of points
    weight : (N,) not negative
    limb : (N,) int in 0 .. count - 1
    count : int, number of limbs
    stay : float [m² times the unit of the weights]
        Preference for small rotations, equal to that of unmoved pairs with a quarter of this as second moment.

    Returns
    -------
    R (count, 3, 3), t (count, 3) [m]; the identity for limbs without pairs

    Raises
    ------
    ObservationError
        Pairs that do not match, are not finite, or have a negative weight.
    """
    n = len(source)
    for array, shape in ((source, (n, 3)), (target, (n, 3)), (weight, (n,)), (limb, (n,))):
        check_shape(array, shape, "pairs")
    if not np.isfinite([source.sum(), target.sum(), weight.sum()]).all() or (n and weight.min() < 0.0):
        raise ObservationError("pairs are not finite, or have a negative weight", remedy="Remove unknown pairs.")
    total = np.bincount(limb, weight, count)
    share = 1.0 / np.where(total > 0.0, total, 1.0)
    mean_source, mean_target = (
        np.stack([np.bincount(limb, weight * x[:, k], count) for k in range(3)], axis=1) * share[:, None]
        for x in (source, target)
    )
    a, b = source - mean_source[limb], (target - mean_target[limb]) * weight[:, None]
    cross = np.stack([np.bincount(limb, b[:, i] * a[:, j], count) for i in range(3) for j in range(3)], axis=1)
    R = nearest_rotation(cross.reshape(-1, 3, 3) + 0.25 * (stay + 1e-12) * np.eye(3))
    return R, mean_target - (R @ mean_source[:, :, None])[..., 0]


def move(frames: NDArray, R: NDArray, t: NDArray) -> NDArray:
    """Frames (S, 12) of segments after motions R (S, 3, 3), t (S, 3) [m] in the world."""
    turned = (R @ frames[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    return np.concatenate([turned, (R @ frames[:, 9:, None])[..., 0] + t], axis=1)


MIN_TURN_STD = np.deg2rad(8.0)
"""[rad] standard deviation of a rotation that determines a centre. Skin displaces a segment's pose by some 3 mm at the
joint, so the centre by 3 mm over the rotation, here 2 cm. In jumps and walks, whose hips turn by 4 to 5 degrees about
their second axis, centres were 28 to 61 mm from the laboratory's; those of all joints jointly were 8 to 18 mm off."""

_MIN_FRAMES = 10
_SPHERE_STARTS = 30  # random samples: one of them has no outliers, if a tenth of the frames does
_OUTLIER_RATIO = 4.0  # to the typical misfit, above which a frame is excluded
_REFITS = 3  # each with outliers of the one before excluded


@dataclass(frozen=True, eq=False)
class FunctionalJoint:
    """A joint centre or axis between two segments.

    Parameters
    ----------
    centre : (F, 3) [m] in the world; of a hinge the point of its axis nearest to the child's markers. NaN in frames
        without poses of both segments.
    axis : (F, 3) unit vector of a hinge, in the world; None for a ball
    spread : float [m] root mean square distance between the joint's places in both segments
    turns : (3,) [rad] standard deviations of the child's rotation in the parent about three orthogonal axes, largest
        first. The error of a centre is that of the segments' poses divided by the second one (hinge: the first).
    """

    centre: NDArray
    axis: NDArray | None
    spread: float
    turns: NDArray


@checked
def functional_centre(markers: Markers, parent: Sequence[str], child: Sequence[str]) -> FunctionalJoint:
    """Estimate the centre of a ball joint, such as a hip, from a take in which it moves about more than one axis.

    Parameters
    ----------
    parent : labels of markers of one segment, three at least
    child : labels of markers of the other segment; with one or two the joint is the centre of the spheres on which
        they move

    Raises
    ------
    ObservationError
        Unknown labels, too few markers or frames, or a joint that hardly moves or moves about one axis only.
    """
    y, x = _columns(markers, parent, 3), _columns(markers, child, 1)
    Rp, tp = _poses(y)
    if x.shape[1] < 3:
        a, spread, turns = _sphere(local(Rp, tp, x))
        return FunctionalJoint(Rp @ a + tp, None, spread, turns)
    Rc, tc = _poses(x)
    good = _both(tp, tc)
    turns = _turns(Rp[good], Rc[good])
    if turns[1] < MIN_TURN_STD:
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
    """Estimate the axis of a hinge, such as a knee, from a take in which it bends.

    Parameters
    ----------
    parent, child : labels of markers of each segment, three at least

    Raises
    ------
    ObservationError
        Unknown labels, too few markers or frames, or a joint that hardly moves.
    """
    y, x = _columns(markers, parent, 3), _columns(markers, child, 3)
    (Rp, tp), (Rc, tc) = _poses(y), _poses(x)
    good = _both(tp, tc)
    turns = _turns(Rp[good], Rc[good])
    if turns[0] < MIN_TURN_STD:
        raise _held(turns, "about its axis", 0)
    for _ in range(_REFITS):
        U, _, Vt = np.linalg.svd(np.einsum("fji,fjk->ik", Rp[good], Rc[good]))
        u, v = U[:, 0], Vt[0]  # unit vectors that minimise Σ |R_p u − R_c v|²
        in_child = nan_median(local(Rc[good], tc[good], x[good]), axis=(0, 1))  # of the child's markers
        start = np.concatenate([_median_in_frame(Rp[good], tp[good], Rc[good] @ in_child + tc[good]), in_child])
        A = np.concatenate([Rp[good], -Rc[good]], axis=2).reshape(-1, 6)
        across = np.linalg.svd(np.concatenate([u, v])[None])[2][1:].T  # (6, 5): a shift along the axis is free
        residual = (tc[good] - tp[good]).ravel() - A @ start
        c = start + across @ np.linalg.lstsq(A @ across, residual, rcond=None)[0]
        off = np.linalg.norm((Rp @ c[:3] + tp) - (Rc @ c[3:] + tc), axis=1)
        good = _inliers(off, good)
    axis = Rp @ u + Rc @ v
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    spread = float(np.sqrt(np.mean(off[good] ** 2)))
    return FunctionalJoint(0.5 * (Rp @ c[:3] + tp + Rc @ c[3:] + tc), axis, spread, turns)


def sphere_centre(x: NDArray) -> tuple[NDArray, NDArray, float]:
    """Fit concentric spheres to points x (F, K, 3) [m], NaN for missing: centre (3,), radii (K,), RMS misfit [m].

    Least squares of the distances from the spheres (Gauss-Newton), which small arcs do not bias inwards, started from
    the algebraic fit of Gamage and Lasenby, J Biomech 35 (2002).
    """
    origin = np.nanmean(x, axis=(0, 1))
    d, known = x - origin, np.isfinite(x).all(axis=2)
    square = np.einsum("fki,fki->fk", d, d)
    A, b = 2.0 * (d - np.nanmean(d, axis=0)), square - np.nanmean(square, axis=0)
    c = origin + np.linalg.lstsq(A[known], b[known], rcond=1e-9)[0]
    for _ in range(50):
        away = x - c
        length = np.linalg.norm(away, axis=2)
        r = length - np.nanmean(length, axis=0)
        J = away / length[..., None]
        J = J - np.nanmean(J, axis=0)
        step = np.linalg.lstsq(J[known], r[known], rcond=1e-9)[0]
        c = c + step
        if np.linalg.norm(step) < 1e-9:
            break
    length = np.linalg.norm(x - c, axis=2)
    radii = np.nanmean(length, axis=0)
    return c, radii, float(np.sqrt(np.nanmean((length - radii) ** 2)))


def _sphere(x: NDArray) -> tuple[NDArray, float, NDArray]:
    """Centre (3,), misfit and turns (3,) of a child of one or two markers (F, k, 3), all in the parent's frame."""
    good = np.isfinite(x).all(axis=2).any(axis=1)
    if good.sum() < _MIN_FRAMES:
        raise _few(int(good.sum()))
    rng, frames, least = np.random.default_rng(0), np.flatnonzero(good), np.inf
    for _ in range(_SPHERE_STARTS):  # least median of squares: robust against half of the frames
        c, radii, _ = sphere_centre(x[rng.choice(frames, min(len(frames), 2 * _MIN_FRAMES), replace=False)])
        off = nan_median(np.abs(np.linalg.norm(x - c, axis=2) - radii), axis=1)
        if (typical := float(np.nanmedian(off[frames]))) < least:
            least, good = typical, _inliers(off, good)
    for _ in range(_REFITS):
        c, radii, misfit = sphere_centre(x[good])
        off = nan_median(np.abs(np.linalg.norm(x - c, axis=2) - radii), axis=1)
        good = _inliers(off, good)
    directions = (x[good] - c) / radii[:, None]
    J = (directions - np.nanmean(directions, axis=0)).reshape(-1, 3)
    known = np.isfinite(J).all(axis=1)
    turns = np.sqrt(np.linalg.eigvalsh(J[known].T @ J[known] / known.sum()))[::-1]
    if turns[1] < MIN_TURN_STD:
        raise _held(turns, "about two axes", 1)
    return c, misfit, turns


def _columns(markers: Markers, labels: Sequence[str], least: int) -> NDArray:
    """(F, k, 3) [m] positions of the named markers."""
    names = [bare(n) for n in markers.names]
    found = [n if n in markers.names else m for n, m in zip(labels, matched(labels, names))]
    for label, name in zip(labels, found):
        if name is None:
            problem = choices("marker", label, markers.names)
            raise ObservationError(problem, file=markers.source or None, remedy="Give labels of the take.")
    if len(set(labels)) < max(least, len(labels)):
        raise ObservationError(
            f"{len(set(labels))} markers of a segment: {', '.join(labels)}", remedy=f"Give at least {least}, each once."
        )
    where = [markers.names.index(n) if n in markers.names else names.index(str(n)) for n in found]
    return np.asarray(markers.positions)[:, where]


def _poses(y: NDArray) -> tuple[NDArray, NDArray]:
    """Rotations (F, 3, 3) and translations (F, 3) of a cluster (F, k, 3); NaN in frames with fewer than 3 markers."""
    if not (np.isfinite(y[..., 0]).sum(1) >= 3).any():
        raise _few(0)
    shape = shape_of(y)
    R, t = rigid_frames(shape, y, rigid_frames(shape, y)[0])  # with its result as prior, so the prior adds no bias
    few = np.isfinite(y[..., 0]).sum(1) < 3
    R[few], t[few] = np.nan, np.nan
    return R, t


def _both(tp: NDArray, tc: NDArray) -> NDArray:
    good = np.isfinite(tp).all(axis=1) & np.isfinite(tc).all(axis=1)
    if good.sum() < _MIN_FRAMES:
        raise _few(int(good.sum()))
    return np.asarray(good)


def _turns(Rp: NDArray, Rc: NDArray) -> NDArray:
    """(3,) [rad] standard deviations of the child's rotation in the parent about three axes, largest first.

    The singular values of the mean relative rotation are mean cosines; two of three angles change each.
    """
    relative = np.einsum("fji,fjk->fik", Rp, Rc)
    s = np.clip(np.linalg.svd(relative.mean(0), compute_uv=False), -1.0, 1.0)
    loss = 2.0 * (1.0 - s)  # of each axis: the sum of the variances of turns about the other two
    variances = 0.5 * loss.sum() - loss
    return np.sqrt(np.clip(np.sort(variances)[::-1], 0.0, None))


def _median_in_frame(R: NDArray, t: NDArray, x: NDArray) -> NDArray:
    """Median place (3,) of world points (F, 3) in a moving frame."""
    return np.asarray(np.median(np.einsum("fji,fj->fi", R, x - t), axis=0))


def _inliers(off: NDArray, before: NDArray) -> NDArray:
    """Frames whose misfit is no outlier; `before` (F,) if fewer than `_MIN_FRAMES` would remain."""
    typical = float(np.nanmedian(off[before]))
    good = np.nan_to_num(off, nan=np.inf) < max(_OUTLIER_RATIO * typical, 1e-6)
    return np.asarray(good if good.sum() >= _MIN_FRAMES else before)


def _few(frames: int) -> ObservationError:
    return ObservationError(
        f"{frames} frames show enough markers of both segments", remedy=f"Give at least {_MIN_FRAMES} such frames."
    )


def _held(turns: NDArray, about: str, which: int) -> ObservationError:
    return ObservationError(
        f"the joint turns {about} by {np.degrees(turns[which]):.1f} deg (standard deviation), too little to find it",
        remedy="Record it moving through its range: a hip swung forwards, outwards and round, a knee bent.",
    )
