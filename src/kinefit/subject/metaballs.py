"""Radii and weights of metaballs: as parameters of a subject fit, and from points on one limb by themselves (P4-8)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.closest._kernels_metaballs import nearest_on_metaballs
from kinefit.bodies.surfaces.metaballs import pack_balls
from kinefit.errors import BodyError, ObservationError
from kinefit.solvers.least_squares import relax
from kinefit.subject.parameters import World

GIRTH = 0.2  # standard deviation of a radius' logarithm between people, as of cylinders' half axes
_WEIGHT = 0.3  # and of a weight's
_STEP = 1e-3
_HUBER = 2.0  # standard deviations
_ITERATIONS, _DONE = 30, 1e-6
_REACH = 0.2  # [m] beyond which no foot of a point is sought
_GONE = 0.2  # of the body's radius: a ball that is smaller has collapsed

ROUNDS = 30, (1, 5)
"""Rounds, and `coarse`, with which `fit_subject` finds radii of metaballs: points are matched anew after every step.
With several steps a round radii follow matches that the poses leave in the next, and end in another minimum: so did
two of four arms."""


@dataclass(frozen=True, eq=False)
class MetaballShape:
    """Logarithms of the radii of a body's metaballs, and of their weights where these are sought; limb by limb.

    Parameters
    ----------
    body : Body with metaballs.
    weights : whether weights are sought too: sharper edges.
    girth : standard deviation of a radius' logarithm.

    Raises
    ------
    BodyError
        A body without metaballs.
    """

    body: Body
    weights: bool = False
    girth: float = GIRTH

    def __post_init__(self) -> None:
        if not self._limbs:
            problem = f"body '{self.body.name}' has no metaballs"
            raise BodyError(problem, remedy="Give its segments a `surface` of balls.")

    @cached_property
    def _limbs(self) -> tuple[tuple[int, Metaballs], ...]:
        """Place among the surfaces, and the limb."""
        return tuple((k, s) for k, s in enumerate(self.body.surfaces) if isinstance(s, Metaballs))

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) "forearm_r ball 1 x" and so on, then "forearm_r ball 1 weight"; limb by limb."""
        out: list[str] = []
        for _, limb in self._limbs:
            name, count = self.body.tree.segments[limb.segment], len(limb.radii)
            out += [f"{name} ball {k + 1} {axis}" for k in range(count) for axis in "xyz"]
            out += [f"{name} ball {k + 1} weight" for k in range(count)] if self.weights else []
        return tuple(out)

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """Of each parameter the segment that it changes."""
        each = [(limb.segment, len(limb.radii) * (3 + self.weights)) for _, limb in self._limbs]
        return tuple(frozenset((segment,)) for segment, count in each for _ in range(count))

    @property
    def mean(self) -> NDArray:
        """(p,) zero."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(p, p)."""
        std = [_WEIGHT if name.endswith("weight") else self.girth for name in self.names]
        return np.diag(np.array(std) ** -2.0)

    @property
    def step(self) -> NDArray:
        """(p,)."""
        return np.full(len(self.names), _STEP)

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these radii and weights."""
        surfaces, first = list(world.body.surfaces), 0
        for k, _ in self._limbs:
            limb = surfaces[k]
            assert isinstance(limb, Metaballs)
            count = len(limb.radii) * (3 + self.weights)
            surfaces[k] = _grown(limb, np.asarray(values[first : first + count], float).tobytes(), self.weights)
            first += count
        return replace(world, body=replace(world.body, surfaces=tuple(surfaces)))


def grown(limb: Metaballs, values: NDArray, *, weights: bool = False) -> Metaballs:
    """A limb with the logarithms of factors on its radii (3 K,), and on its weights (K,) after them."""
    radii, w = _scaled(limb, values, weights)
    return limb.changed(radii, w if weights else None)


def _scaled(limb: Metaballs, values: NDArray, weights: bool) -> tuple[NDArray, NDArray]:
    """Radii (K, 3) [m] and weights (K,)."""
    count = limb.radii.size
    w = limb.weights * np.exp(values[count:]) if weights else limb.weights
    return limb.radii * np.exp(values[:count]).reshape(-1, 3), w


@lru_cache(maxsize=64)
def _grown(limb: Metaballs, values: bytes, weights: bool) -> Metaballs:
    """As `grown`: derivatives change one limb at a time, and the others need no new mesh."""
    return grown(limb, np.frombuffer(values), weights=weights)


@dataclass(frozen=True, eq=False)
class BallFit:
    """A limb fitted to points.

    Parameters
    ----------
    limb : Metaballs
    std : (p,) standard deviations of the logarithms of radii (3 K), and weights (K) where they were sought.
    rms : float [m] of the points' distances.
    iterations : int
    """

    limb: Metaballs
    std: NDArray
    rms: float
    iterations: int


def fit_balls(
    limb: Metaballs, x: ArrayLike, sigma: ArrayLike, *, weights: bool = False, girth: float = GIRTH
) -> BallFit:
    """Radii, and weights, with which a limb's field is 1/2 at points on its surface (P4, eq. 15), by least squares.

    A residual is the distance [m] of a point from where the field is 1/2; its derivatives by radii and weights are
    exact: (∂F/∂p) / |∇F| at the nearest point of the surface.
    Robust (Huber), with a prior of `girth` about the radii that the limb has.

    Parameters
    ----------
    x : (N, 3) [m] in the segment's frame.
    sigma : (N,) or one, [m] standard deviations.

    Raises
    ------
    ObservationError
        Fewer points than radii, points that are not finite.
    BodyError
        A ball that collapses: its radius falls below a fifth of what it was.
    """
    x = np.asarray(x, float)
    s = np.broadcast_to(np.asarray(sigma, float), len(x))
    count = limb.radii.size + len(limb.weights) * weights
    if x.ndim != 2 or x.shape[1:] != (3,) or len(x) < count or not np.isfinite(x).all() or not (s > 0).all():
        problem = f"{len(x)} points of shape {x.shape} for {count} numbers of a limb"
        raise ObservationError(problem, remedy="Give more points (N, 3) about it, finite, with positive deviations.")
    prior = np.concatenate([np.full(limb.radii.size, girth), np.full(count - limb.radii.size, _WEIGHT)]) ** -2.0
    theta, damping, now = np.zeros(count), 1e-3, limb
    H, b, cost, rms = _normal(now, x, s, weights)
    tried = 0
    for _ in range(_ITERATIONS):
        tried += 1
        A, right = H + np.diag(prior), b - prior * theta
        step = np.linalg.solve(A + damping * np.diag(np.diag(A)), right)
        trial = theta + np.clip(step, -0.5, 0.5)
        if trial[: limb.radii.size].min() < np.log(_GONE):
            damping *= 10.0
            if damping > 1e8:
                k = int(np.argmin(trial[: limb.radii.size])) // 3
                problem = f"ball {k + 1} of segment {limb.segment} collapses: a radius below a fifth of what it was"
                raise BodyError(problem, remedy="Give points about all of the limb, or fewer balls.")
            continue
        there = _unmeshed(limb, trial, weights)
        H2, b2, cost2, rms2 = _normal(there, x, s, weights)
        if cost2 + prior @ trial**2 <= cost + prior @ theta**2:
            theta, now, H, b, cost, rms, damping = trial, there, H2, b2, cost2, rms2, relax(damping)
            if np.abs(step).max() < _DONE:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    covariance = np.linalg.inv(H + np.diag(prior))
    return BallFit(grown(limb, theta, weights=weights), np.sqrt(np.diag(covariance)), rms, tried)


def _unmeshed(limb: Metaballs, values: NDArray, weights: bool) -> Metaballs:
    """As `grown`, with the old mesh: for its field alone."""
    radii, w = _scaled(limb, values, weights)
    return replace(limb, radii=radii, weights=w)


def _normal(limb: Metaballs, x: NDArray, sigma: NDArray, weights: bool) -> tuple[NDArray, NDArray, float, float]:
    """Normal matrix and right side by logarithms, robust cost, RMS distance [m]."""
    limbs, balls = pack_balls([limb.on(0)], np.zeros((1, 3)))
    r, normal, found = np.full(len(x), _REACH), np.zeros((3, len(x))), np.full(len(x), -1)
    here = np.concatenate([np.eye(3).ravel(), np.zeros(3)])[None]
    limbs[:, 6] = np.inf  # the mesh, from which the sphere about a limb is taken, is that of other radii
    nearest_on_metaballs(np.ascontiguousarray(x.T), here, limbs, balls, np.full(len(x), -1), r, normal, found)
    d = limb.derivatives((x.T - np.where(found >= 0, r, 0.0) * normal).T)
    slope = np.maximum(np.linalg.norm(d.by_point, axis=1), 1e-9)
    J = (d.by_radii * limb.radii).reshape(len(x), -1)
    if weights:
        J = np.concatenate([J, d.by_weights * limb.weights], axis=1)
    J = J / slope[:, None]  # how far the surface moves outwards
    size = np.abs(r) / sigma
    w = np.where(found >= 0, np.minimum(1.0, _HUBER / np.maximum(size, 1e-12)), 0.0) / sigma**2
    cost = np.sum(np.where(size < _HUBER, size**2, _HUBER * (2 * size - _HUBER)))
    return J.T @ (w[:, None] * J), J.T @ (w * r), float(cost), float(np.sqrt(np.mean(r * r)))
