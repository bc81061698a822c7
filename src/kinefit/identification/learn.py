"""A marker model learnt from labelled takes: what holds its distance to what, and where segments meet (P5 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.identification.from_frame import (
    JOINT_SPREAD, Skeleton, adopt, guess_deviation, pivot, place_joints, reach, skeleton_of,
)
from kinefit.identification.marker_sets import MarkerSet, find_marker_set, load_marker_set
from kinefit.identification.model import MarkerJoint, MarkerModel
from kinefit.observations import Markers

MOST_FRAMES = 1000
"""Frames that are looked at, spread over the take: neighbours in time say the same."""

SELDOM = 0.01
"""A label that fewer of the frames show is left out: mostly a rest of somebody's editing ("RBAC-1")."""


def learn_model(markers: Markers, *, name: str = "subject", template: MarkerSet | str | None = None) -> MarkerModel:
    """What the markers of a labelled take hold to each other.

    Parameters
    ----------
    markers : Markers, labelled; several takes of the subject put one after the other are one take
    template : MarkerSet, or the name or file of one
        Its segments and joints are taken as the start, so that joints which were held still do not merge segments.
        Default: the catalogue's set that knows the labels. "" learns segments from the motion alone.

    Raises
    ------
    ObservationError
        The template does not fit the labels, or no frame shows three markers of the root.
    """
    marker_set = load_marker_set(template) if isinstance(template, str) and template else template
    if template is None:
        marker_set = find_marker_set(markers.names)
    positions, labels, gaps = usable(markers, marker_set or None)
    tables = distances(positions)
    if not isinstance(marker_set, MarkerSet):
        raise ObservationError("no marker set knows these labels", remedy="Give a template.")
    skeleton = adopt(skeleton_of(labels, marker_set), tables[1])
    return fit_model(positions, labels, skeleton, tables, name, gaps)


def usable(markers: Markers, marker_set: MarkerSet | None) -> tuple[NDArray, list[str], tuple[str, ...]]:
    """Positions (F, M, 3) [m] of real, labelled markers in at most MOST_FRAMES frames, labels, those seldom seen."""
    seen = np.isfinite(markers.positions[..., 0])
    keep = [
        i for i, label in enumerate(markers.names)
        if seen[:, i].sum() >= max(3, SELDOM * len(seen)) and not label.startswith("*") and not (marker_set and marker_set.is_computed(label))
    ]
    left_out = [n for i, n in enumerate(markers.names) if i not in keep and not n.startswith("*")]
    left_out = [n for n in left_out if not (marker_set and marker_set.is_computed(n))]
    if len(keep) < 3:
        raise ObservationError(f"{len(keep)} labelled markers are ever seen", remedy="A model needs three and more.")
    rows = np.flatnonzero(seen[:, keep].sum(1) >= 3)
    step = max(1, -(-len(rows) // MOST_FRAMES))
    gaps = left_out + [markers.names[i] for i in keep if seen[:, i].mean() < 0.1]
    return markers.positions[rows[::step]][:, keep], [markers.names[i] for i in keep], tuple(gaps)


def distances(positions: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """(M, M) [m] each: mean, standard deviation, least and largest distance; robust to a few wrong labels.

    Deviations beyond five times the median one count as five; least and largest are the 0.5 and 99.5 % quantiles.
    NaN for two that were never seen together.
    """
    count = positions.shape[1]
    mean, deviation, low, high = (np.full((count, count), np.nan) for _ in range(4))
    for i in range(count):
        d = np.linalg.norm(positions - positions[:, i, None], axis=-1)
        together = np.isfinite(d).any(0)
        middle = np.nanmedian(d[:, together], axis=0)
        away = np.abs(d[:, together] - middle)
        most = 5 * 1.4826 * np.nanmedian(away, axis=0) + 1e-4
        inside = np.clip(d[:, together], middle - most, middle + most)
        mean[i, together], deviation[i, together] = np.nanmean(inside, axis=0), np.nanstd(inside, axis=0)
        low[i, together], high[i, together] = np.nanquantile(d[:, together], [0.005, 0.995], axis=0)
    return mean, deviation, low, high


def fit_model(
    positions: NDArray, labels: list[str], skeleton: Skeleton, tables: tuple[NDArray, NDArray, NDArray, NDArray],
    name: str, gaps: tuple[str, ...],
) -> MarkerModel:
    """The model of segments that are known."""
    mean, deviation, low, high = tables
    reference = mean_shape(positions, skeleton.members, mean)
    places = place_joints(reference, skeleton)
    joints: list[MarkerJoint] = []
    Rs: list[NDArray] = []
    ts: list[NDArray] = []
    for s, members in enumerate(skeleton.members):
        p = skeleton.parents[s]
        x, y = reference[list(members)], positions[:, list(members)]
        if p < 0:
            R, t = rigid_frames(x, y, np.broadcast_to(np.eye(3), (len(y), 3, 3)))
        else:
            marker = pivot(skeleton, s, places[s], reference)
            guess = places[s] if marker is None else reference[marker]
            a = b = guess
            if marker is None:
                R, t = rigid_frames(x, y, Rs[p])
                a, b = meet(Rs[p], ts[p], R, t, x, y, guess)
            known = Rs[p] @ a + ts[p]
            R, t = rigid_frames(np.vstack([x, b]), np.concatenate([y, known[:, None]], 1), Rs[p])
            spread = np.linalg.norm(known - (R @ b + t), axis=-1)
            spread = spread[np.isfinite(spread)]
            joints.append(MarkerJoint(
                p, s, a, b, float(np.sqrt(np.median(spread**2))) if len(spread) else JOINT_SPREAD, marker,
                turned(Rs[p], R),
            ))
        Rs.append(R)
        ts.append(t)
    tree_low, tree_high = reach(reference, skeleton.members, joints)
    own = np.linalg.norm(reference[:, None] - reference, axis=-1)
    mean = np.where(np.isfinite(mean), mean, own)
    guess_dev = guess_deviation(mean, skeleton.members, tree_low, tree_high)
    deviation = np.where(np.isfinite(deviation), np.maximum(deviation, 0.002), guess_dev)
    np.fill_diagonal(deviation, 0.0)
    low, high = np.where(np.isfinite(low), low, tree_low), np.where(np.isfinite(high), high, tree_high)
    return MarkerModel(
        name, tuple(labels), reference, skeleton.members, skeleton.names, tuple(joints), mean, deviation, low, high, gaps
    )


def rigid_frames(x: NDArray, y: NDArray, prior: NDArray) -> tuple[NDArray, NDArray]:
    """Rotations (F, 3, 3), translations (F, 3) that lay x (k, 3) onto y (F, k, 3); NaN in y is not seen.

    What the points leave open (two of them, or one) follows `prior` (F, 3, 3). NaN where nothing is seen.
    """
    seen = np.isfinite(y[..., 0])
    count = np.maximum(seen.sum(1), 1)[:, None]
    x_all = np.where(seen[..., None], x, 0.0)
    y_all = np.where(seen[..., None], y, 0.0)
    x_mid, y_mid = x_all.sum(1) / count, y_all.sum(1) / count
    a = np.where(seen[..., None], x - x_mid[:, None], 0.0)
    b = np.where(seen[..., None], y_all - y_mid[:, None], 0.0)
    size = (a * a).sum((1, 2))[:, None, None]
    cross = np.einsum("fki,fkj->fij", b, a) + (1e-4 * size + 1e-12) * np.where(np.isfinite(prior), prior, np.eye(3))
    u, _, vt = np.linalg.svd(cross)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    R = u @ vt
    t = y_mid - np.einsum("fij,fj->fi", R, x_mid)
    nothing = ~seen.any(1)
    R[nothing], t[nothing] = np.nan, np.nan
    return R, t


def mean_shape(positions: NDArray, segments: tuple[tuple[int, ...], ...], mean: NDArray) -> NDArray:
    """(M, 3) [m] each segment's mean shape, laid onto the frame that shows most and is nearest to the mean distances."""
    seen = np.isfinite(positions[..., 0])
    best = np.flatnonzero(seen.sum(1) == seen.sum(1).max())
    best = best[:: max(1, len(best) // 200)]
    within = np.zeros(mean.shape, bool)
    for m in segments:
        within[np.ix_(m, m)] = True
    misfit = []
    for f in best:
        d = np.abs(np.linalg.norm(positions[f][:, None] - positions[f], axis=-1) - mean)[within]
        misfit.append(np.nanmean(d))
    frame = positions[best[int(np.argmin(misfit))]]
    sums, weights = np.zeros_like(frame), np.zeros(len(frame))
    prior = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    for m in segments:
        index = list(m)
        y = positions[:, index]
        shape = frame[index]
        if not np.isfinite(shape).all():
            whole = np.isfinite(y[..., 0]).sum(1)
            shape = y[int(np.argmax(whole))]
            shape = np.where(np.isfinite(shape), shape, np.nanmean(shape, axis=0))
        for _ in range(4):
            R, t = rigid_frames(shape, y, prior)
            back = np.einsum("fji,fkj->fki", R, y - t[:, None])
            here = np.isfinite(back[..., 0])
            middle = np.nanmedian(np.where(here[..., None], back, np.nan), axis=0)
            shape = np.where(np.isfinite(middle), middle, shape)
        R, t = rigid_frames(shape, frame[None, index], prior[:1])
        if np.isfinite(t).all():
            sums[index] += shape @ R[0].T + t[0]
            weights[index] += 1
    placed = weights > 0
    if not placed.all():
        raise ObservationError("no frame shows all segments", remedy="Give a take in which every marker is seen.")
    return sums / weights[:, None]


def meet(Rp: NDArray, tp: NDArray, Rc: NDArray, tc: NDArray, x: NDArray, y: NDArray, guess: NDArray) -> tuple[NDArray, NDArray]:
    """The point that is constant in both frames: a in the parent's, b in the child's, from the reference place `guess`.

    Least squares of R_p a + t_p = R_c b + t_c over all frames; along directions that the motion does not tell (a
    hinge's axis, or a joint held still) both stay at the guess, which counts as much as one centimetre in three.
    """
    if len(x) < 3:
        return meet_few(Rp, tp, x, y, guess)
    good = np.isfinite(tp).all(1) & np.isfinite(tc).all(1)
    if not good.any():
        return guess, guess
    A = np.concatenate([Rp[good], -Rc[good]], axis=2)
    r = tc[good] - tp[good] - (A @ np.concatenate([guess, guess]))
    H = np.einsum("fij,fik->jk", A, A) / good.sum()
    g = np.einsum("fij,fi->j", A, r) / good.sum()
    step = np.linalg.solve(H + 0.02 * np.eye(6), g)
    return guess + step[:3], guess + step[3:]


def meet_few(Rp: NDArray, tp: NDArray, x: NDArray, y: NDArray, guess: NDArray) -> tuple[NDArray, NDArray]:
    """The same for a child of one or two markers: the point of the parent that keeps its distance to each."""
    good = np.isfinite(tp).all(1)
    a = guess.copy()
    local = np.einsum("fji,fkj->fki", Rp[good], y[good] - tp[good][:, None])
    for _ in range(5):
        away = local - a
        length = np.linalg.norm(away, axis=-1)
        typical = np.nanmedian(length, axis=0)
        J = -away / length[..., None]
        r = typical - length
        ok = np.isfinite(r)
        if not ok.any():
            return guess, guess
        J, r = J[ok], r[ok]
        a = a + np.linalg.solve(J.T @ J / len(r) + 0.02 * np.eye(3), J.T @ r / len(r) + 0.02 * (guess - a))
    # in the child: at those distances from its markers, nearest to where the parent's lies in the reference
    b = a.copy()
    typical = np.nanmedian(np.linalg.norm(local - a, axis=-1), axis=0)
    for _ in range(10):
        away = b - x
        length = np.linalg.norm(away, axis=-1)
        J, r = away / length[:, None], typical - length
        b = b + np.linalg.lstsq(J, r, rcond=1e-3)[0]
    return a, b


def turned(Rp: NDArray, Rc: NDArray) -> float:
    """[rad] range of a joint: twice the angle from the mean attitude that 5 % of the frames exceed."""
    relative = np.einsum("fji,fjk->fik", Rp, Rc)
    relative = relative[np.isfinite(relative).all((1, 2))]
    if not len(relative):
        return 0.0
    u, _, vt = np.linalg.svd(relative.mean(0))
    middle = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    cosine = (np.einsum("ij,fij->f", middle, relative) - 1) / 2
    return float(2 * np.quantile(np.arccos(np.clip(cosine, -1, 1)), 0.95))
