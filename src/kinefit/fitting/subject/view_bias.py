"""Estimate the detectors' bias by direction of view from frames with known poses, without ground truth.

Residuals r of a keypoint in the cameras c of one frame are r_c = J_c (s + e(d_c)) + noise. The error s of the body's
point is free in every frame. The bias e is the same in all frames, so only disagreement between cameras determines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.observations.recordings import mirror_name
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.views import MIRRORED, TERMS, ViewBias, directions, trunks

_COEFFICIENT_PRIOR_STD = 0.01  # [m]: of 1, 1.4 and 2 cm the best on three recordings of the built-in network
# (benchmark `people_bias`); 2 cm gains more on two of them, and loses 7 % on the third
_NOISE_STD = 0.01  # [m] of a keypoint's remaining error: frames of a take are alike, so all count as one measurement
_POINT_STD = 0.03  # [m] of s, the error of a fitted body's point in a frame
_OUTLIER_SIGMAS = 2.0  # at which a keypoint's weight falls to 1/4
_ROUNDS = 4  # of reweighting
_MIN_CAMERAS = 3  # that detect a point; two disagree as much where the body is wrong
_MAX_FOLLOWED_SHARE = 0.5  # of a point's bias that counts as explained
_MAX_FRAMES = 13  # of a take
_MIRROR = np.diag([1.0, 1.0, -1.0])  # of a left point's axes


@dataclass(frozen=True, eq=False)
class SeenFrames:
    """K frames of a take at known poses.

    Parameters
    ----------
    body : Body
    channels : N channels of keypoints
    states : K poses
    uv : (K, N, 2) [px], left-right swaps corrected
    confidence : (K, N), 0 where undetected
    """

    body: Body
    channels: Channels
    states: Sequence[BodyState]
    uv: NDArray
    confidence: NDArray

    def few(self) -> SeenFrames:
        """At most `_MAX_FRAMES` of the frames, evenly spaced."""
        chosen = np.unique(np.linspace(0, len(self.states) - 1, min(_MAX_FRAMES, len(self.states))).astype(int))
        states = [self.states[k] for k in chosen]
        return SeenFrames(self.body, self.channels, states, self.uv[chosen], self.confidence[chosen])


@dataclass(frozen=True, eq=False)
class _PointRows:
    """Rows of L points, each in K frames and C cameras: r = X s + A c, two rows for each camera, whitened.

    A left point shares the coefficients of the right one; `lead` (L,) is the number of the right one.
    """

    lead: NDArray
    A: NDArray  # (L, K, 2C, 15)
    X: NDArray  # (L, K, 2C, 3)
    r: NDArray  # (L, K, 2C)

    def equations(self, c: NDArray) -> tuple[NDArray, NDArray]:
        """Normal equations (L, 15, 15), (L, 15) with s eliminated, averaged over frames; weights at c (L, 15)."""
        w = self._weight(c)
        A, X, r = self.A * w[..., None], self.X * w[..., None], self.r * w
        shift = np.linalg.solve(_shift_information(X), X.swapaxes(2, 3) @ np.concatenate([A, r[..., None]], axis=3))
        H = A.swapaxes(2, 3) @ (A - X @ shift[..., :-1])
        b = (A.swapaxes(2, 3) @ (r[..., None] - X @ shift[..., -1:]))[..., 0]
        frames = np.maximum(np.count_nonzero(self.X.any(axis=(2, 3)), axis=1), 1)
        return H.sum(axis=1) / frames[:, None, None], b.sum(axis=1) / frames[:, None]

    def _weight(self, c: NDArray) -> NDArray:
        """(L, K, 2C) square root of the robust weight of every row."""
        residual = self.r - (self.A @ c[:, None, :, None])[..., 0]
        s = np.linalg.solve(_shift_information(self.X), self.X.swapaxes(2, 3) @ residual[..., None])
        residual = residual - (self.X @ s)[..., 0]
        square = np.square(residual).reshape(*residual.shape[:2], -1, 2).sum(axis=3)
        return np.repeat(1.0 / (1.0 + square / _OUTLIER_SIGMAS**2), 2, axis=2)


def _shift_information(X: NDArray) -> NDArray:
    return np.eye(3) / _POINT_STD**2 + X.swapaxes(2, 3) @ X


def learn_view_bias(takes: Sequence[SeenFrames]) -> ViewBias:
    """Estimate the biases common to some takes, of points that three cameras detect in the same frame.

    Parameters
    ----------
    takes : each counts as one measurement of each side of a person
    """
    keys: dict[tuple[str, str], int] = {}
    rows_of_takes = [rows for take in takes if (rows := _point_rows(take.few(), keys)) is not None]
    if not keys:
        return ViewBias()
    # A point in the middle is its own mirror image: antisymmetric coefficients are 0.
    paired = np.array([mirror_name(point) != point for _, point in keys])
    prior = np.where((MIRRORED.ravel() > 0) | paired[:, None], _COEFFICIENT_PRIOR_STD, 1e-9)
    errors = np.zeros(len(keys))
    c: NDArray = np.zeros(prior.shape)
    for _ in range(_ROUNDS):
        H, b = np.zeros((*prior.shape, 3 * TERMS)), np.zeros(prior.shape)
        H[:, np.arange(3 * TERMS), np.arange(3 * TERMS)] = prior**-2.0
        for rows in rows_of_takes:
            take_H, take_b = rows.equations(c[rows.lead])
            np.add.at(H, rows.lead, take_H)
            np.add.at(b, rows.lead, take_b)
        c = np.linalg.solve(H, b[..., None])[..., 0]
    for rows in rows_of_takes:
        np.add.at(errors, rows.lead, np.count_nonzero(rows.X.any(axis=(1, 3)), axis=1))
    measured = np.sum(1.0 - np.diagonal(np.linalg.inv(H), axis1=1, axis2=2) / np.square(prior), axis=1)
    sets: dict[str, dict[str, NDArray]] = {}
    followed: dict[str, dict[str, float]] = {}
    for (name, point), k in keys.items():
        other, found = mirror_name(point), c[k].reshape(TERMS, 3)
        share = min(float(measured[k] / errors[k]), _MAX_FOLLOWED_SHARE)
        points, shares = sets.setdefault(name, {}), followed.setdefault(name, {})
        points[other], shares[other] = found * MIRRORED, share
        points[point], shares[point] = found, share
    return ViewBias(sets, followed)


def _point_rows(take: SeenFrames, keys: dict[tuple[str, str], int]) -> _PointRows | None:
    """Rows of every point of a take that three cameras detect; None for no point.

    Pairs of points that `keys` lacks are added to it, by the right one's name.
    """
    body, channels = take.body, take.channels
    points = channels.with_points(body).points
    x = np.stack([body.positions(state, points) for state in take.states])
    frames = np.stack([body.tree.forward(s.T_world_root, s.angles)[0] for s in take.states])
    K, C, L = len(x), len(channels.rig), len(points)
    A, X, r = np.zeros((L, K, C, 2, 3 * TERMS)), np.zeros((L, K, C, 2, 3)), np.zeros((L, K, C, 2))
    names = [(name, points.names[k]) for name, span in channels.sets.items() for k in range(span.start, span.stop)]
    is_left = np.array([_right_of(point) != point for _, point in names])
    axes = frames[:, trunks(body.tree)[points.segments], :9].reshape(K, L, 3, 3) @ np.where(
        is_left[:, None, None], _MIRROR, np.eye(3)
    )
    for c, camera in enumerate(channels.rig):
        in_camera = np.flatnonzero(channels.camera == c)
        k = channels.column[in_camera]
        fitted, J = camera.project_with_jacobian(x[:, k])
        d = camera.centre_world - x[:, k]
        d = ((d / np.linalg.norm(d, axis=2)[..., None])[:, :, None] @ axes[:, k])[:, :, 0]
        J, gap = J @ axes[:, k], take.uv[:, in_camera] - fitted
        scale = np.sqrt(0.5 * np.square(J).sum(axis=(2, 3)))  # [px/m]
        confidence = take.confidence[:, in_camera]
        known = (confidence > 0) & np.isfinite(gap).all(axis=2) & (scale > 0)
        weight = np.where(known, np.sqrt(confidence) / (_NOISE_STD * np.where(known, scale, 1.0)), 0.0)
        J = np.where(known[..., None, None], J, 0.0) * weight[..., None, None]
        X[k, :, c] = J.swapaxes(0, 1)
        by_direction = J[:, :, :, None, :] * directions(d)[:, :, None, :, None]
        A[k, :, c] = by_direction.reshape(*J.shape[:3], 3 * TERMS).swapaxes(0, 1)
        r[k, :, c] = (np.where(known[..., None], gap, 0.0) * weight[..., None]).swapaxes(0, 1)
    enough = np.count_nonzero(X.any(axis=(3, 4)), axis=2) >= _MIN_CAMERAS
    used = np.flatnonzero(enough.any(axis=1))
    if not len(used):
        return None
    parts = [np.where(enough[(...,) + (None,) * (v.ndim - 2)], v, 0.0)[used] for v in (A, X, r)]
    lead = [keys.setdefault((names[k][0], _right_of(names[k][1])), len(keys)) for k in used]
    return _PointRows(np.array(lead), *(v.reshape(len(used), K, 2 * C, *v.shape[4:]) for v in parts))


def _right_of(point: str) -> str:
    """Name of the right point of a pair."""
    other = mirror_name(point)
    is_left = (point[:1] == "L" and other[:1] == "R") or "left" in point
    return other if is_left else point
