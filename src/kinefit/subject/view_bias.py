"""Bias by direction of view, learnt from frames whose poses are known, with no truth but all cameras together.

Residuals r of a keypoint in the cameras c of one frame are r_c = J_c (s + e(d_c)) + noise: s is what the body's point
is off by, free in every frame, and e the bias, the same in all. Only what cameras disagree in tells of e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.sensors.channels import Channels, mirror_name
from kinefit.sensors.points.view_bias import MIRRORED, TERMS, ViewBias, directions, trunks

_PRIOR = 0.01  # [m] standard deviation of a coefficient: of 1, 1.4 and 2 cm the best on three recordings of the
# built-in network (`benchmarks.people_bias`); 2 cm gains more on two of them, and loses 7 % on the third
_NOISE = 0.01  # [m] of a keypoint beside it, in a whole take: frames are alike, all of them count as one look
_FREE = 0.03  # [m] standard deviation of s, by which a fitted body's point is off in a frame
_OUTLIER = 2.0  # standard deviations at which a keypoint counts a quarter
_ROUNDS = 4  # of weighing outliers down
_CAMERAS = 3  # that show a point; two disagree as much where the body is wrong
_MOST = 0.5  # of a point's lasting errors that count as followed
_FRAMES = 13  # of a take, at most
_LEFT = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class SeenFrames:
    """K frames of a take at known poses.

    Parameters
    ----------
    body : Body
    channels : Channels, N of which the frames have measurements
    states : K poses
    uv : (K, N, 2) [px], left and right put right
    confidence : (K, N), 0 where unseen
    """

    body: Body
    channels: Channels
    states: Sequence[BodyState]
    uv: NDArray
    confidence: NDArray

    def few(self) -> SeenFrames:
        """Not more than `_FRAMES` of them, spread evenly."""
        chosen = np.unique(np.linspace(0, len(self.states) - 1, min(_FRAMES, len(self.states))).astype(int))
        states = [self.states[k] for k in chosen]
        return SeenFrames(self.body, self.channels, states, self.uv[chosen], self.confidence[chosen])


@dataclass(frozen=True, eq=False)
class _Looks:
    """L points, each in K frames and C cameras: r = X s + A c, two rows a camera, each [m] over its noise.

    The coefficients of a left point are those of the right one, whose number is `lead` (L,).
    """

    lead: NDArray
    A: NDArray  # (L, K, 2C, 15)
    X: NDArray  # (L, K, 2C, 3)
    r: NDArray  # (L, K, 2C)

    def equations(self, c: NDArray) -> tuple[NDArray, NDArray]:
        """(L, 15, 15), (L, 15) with s eliminated, the mean over the frames; outliers about coefficients (L, 15)."""
        w = self._weight(c)
        A, X, r = self.A * w[..., None], self.X * w[..., None], self.r * w
        gone = np.linalg.solve(_of_shift(X), X.swapaxes(2, 3) @ np.concatenate([A, r[..., None]], axis=3))
        H = A.swapaxes(2, 3) @ (A - X @ gone[..., :-1])
        b = (A.swapaxes(2, 3) @ (r[..., None] - X @ gone[..., -1:]))[..., 0]
        frames = np.maximum(np.count_nonzero(self.X.any(axis=(2, 3)), axis=1), 1)
        return H.sum(axis=1) / frames[:, None, None], b.sum(axis=1) / frames[:, None]

    def _weight(self, c: NDArray) -> NDArray:
        """(L, K, 2C) square root of the robust weight of every row."""
        left = self.r - (self.A @ c[:, None, :, None])[..., 0]
        s = np.linalg.solve(_of_shift(self.X), self.X.swapaxes(2, 3) @ left[..., None])
        left = left - (self.X @ s)[..., 0]
        square = np.square(left).reshape(*left.shape[:2], -1, 2).sum(axis=3)
        return np.repeat(1.0 / (1.0 + square / _OUTLIER**2), 2, axis=2)


def _of_shift(X: NDArray) -> NDArray:
    return np.eye(3) / _FREE**2 + X.swapaxes(2, 3) @ X


def learn_view_bias(takes: Sequence[SeenFrames]) -> ViewBias:
    """Biases that some takes have in common; of points that three cameras never show at once, none.

    Parameters
    ----------
    takes : each counts as one look at each side of a person.
    """
    keys: dict[tuple[str, str], int] = {}
    looks = [one for take in takes if (one := _looks(take.few(), keys)) is not None]
    if not keys:
        return ViewBias()
    # A point in the middle is its own mirror image: what is not alike from both sides is 0.
    alike = np.array([mirror_name(point) != point for _, point in keys])
    prior = np.where((MIRRORED.ravel() > 0) | alike[:, None], _PRIOR, 1e-9)
    errors = np.zeros(len(keys))
    c: NDArray = np.zeros(prior.shape)
    for _ in range(_ROUNDS):
        H, b = np.zeros((*prior.shape, 3 * TERMS)), np.zeros(prior.shape)
        H[:, np.arange(3 * TERMS), np.arange(3 * TERMS)] = prior**-2.0
        for one in looks:
            of_H, of_b = one.equations(c[one.lead])
            np.add.at(H, one.lead, of_H)
            np.add.at(b, one.lead, of_b)
        c = np.linalg.solve(H, b[..., None])[..., 0]
    for one in looks:
        np.add.at(errors, one.lead, np.count_nonzero(one.X.any(axis=(1, 3)), axis=1))
    told = np.sum(1.0 - np.diagonal(np.linalg.inv(H), axis1=1, axis2=2) / np.square(prior), axis=1)
    sets: dict[str, dict[str, NDArray]] = {}
    followed: dict[str, dict[str, float]] = {}
    for (name, point), k in keys.items():
        other, found, share = mirror_name(point), c[k].reshape(TERMS, 3), min(float(told[k] / errors[k]), _MOST)
        points, shares = sets.setdefault(name, {}), followed.setdefault(name, {})
        points[other], shares[other] = found * MIRRORED, share
        points[point], shares[point] = found, share
    return ViewBias(sets, followed)


def _looks(take: SeenFrames, keys: dict[tuple[str, str], int]) -> _Looks | None:
    """Every point of a take that three cameras show; `keys` number the right one of each pair. None for no point."""
    body, channels = take.body, take.channels
    points = channels.with_points(body).points
    x = np.stack([body.positions(state, points) for state in take.states])
    frames = np.stack([body.tree.forward(s.T_world_root, s.angles)[0] for s in take.states])
    K, C, L = len(x), len(channels.rig), len(points)
    A, X, r = np.zeros((L, K, C, 2, 3 * TERMS)), np.zeros((L, K, C, 2, 3)), np.zeros((L, K, C, 2))
    names = [(name, points.names[k]) for name, span in channels.sets.items() for k in range(span.start, span.stop)]
    left = np.array([_right_of(point) != point for _, point in names])
    axes = frames[:, trunks(body.tree)[points.segments], :9].reshape(K, L, 3, 3) @ np.where(
        left[:, None, None], _LEFT, np.eye(3)
    )
    for c, camera in enumerate(channels.rig):
        mine = np.flatnonzero(channels.camera == c)
        k = channels.column[mine]
        fitted, J = camera.project_with_jacobian(x[:, k])
        d = camera.centre_world - x[:, k]
        d = ((d / np.linalg.norm(d, axis=2)[..., None])[:, :, None] @ axes[:, k])[:, :, 0]
        J, gap = J @ axes[:, k], take.uv[:, mine] - fitted
        scale = np.sqrt(0.5 * np.square(J).sum(axis=(2, 3)))  # [px/m]
        known = (take.confidence[:, mine] > 0) & np.isfinite(gap).all(axis=2) & (scale > 0)
        weight = np.where(known, np.sqrt(take.confidence[:, mine]) / (_NOISE * np.where(known, scale, 1.0)), 0.0)
        J = np.where(known[..., None, None], J, 0.0) * weight[..., None, None]
        X[k, :, c] = J.swapaxes(0, 1)
        by_direction = J[:, :, :, None, :] * directions(d)[:, :, None, :, None]
        A[k, :, c] = by_direction.reshape(*J.shape[:3], 3 * TERMS).swapaxes(0, 1)
        r[k, :, c] = (np.where(known[..., None], gap, 0.0) * weight[..., None]).swapaxes(0, 1)
    enough = np.count_nonzero(X.any(axis=(3, 4)), axis=2) >= _CAMERAS
    used = np.flatnonzero(enough.any(axis=1))
    if not len(used):
        return None
    seen = [np.where(enough[(...,) + (None,) * (v.ndim - 2)], v, 0.0)[used] for v in (A, X, r)]
    lead = [keys.setdefault((names[k][0], _right_of(names[k][1])), len(keys)) for k in used]
    return _Looks(np.array(lead), *(v.reshape(len(used), K, 2 * C, *v.shape[4:]) for v in seen))


def _right_of(point: str) -> str:
    """The right one of a pair of points, by its name."""
    other = mirror_name(point)
    left = (point[:1] == "L" and other[:1] == "R") or "left" in point
    return other if left else point
