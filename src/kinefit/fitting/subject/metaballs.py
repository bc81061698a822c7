"""Radii and weights of metaballs: as parameters of a subject fit, or fitted to points on one limb (P4-8)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.closest._kernels_metaballs import nearest_on_metaballs
from kinefit.bodies.surfaces.metaballs import LEVEL, pack_balls
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.subject.parameters import Parameters, World
from kinefit.geometry.losses import SQUARED, Loss, huber
from kinefit.solving.equations import inverse
from kinefit.solving.least_squares import MAX_DAMPING, Damping, descend

RADIUS_STD = 0.2
"""Standard deviation of a radius' logarithm between people, as of cylinders' half axes."""
_WEIGHT_STD = 0.3  # standard deviation of a weight's logarithm
_HUBER_SIGMAS = 2.0
_MAX_ITERATIONS = 30
_TOLERANCE = 1e-10  # share of the cost that a step must be predicted to lower it by
_MAX_POINT_DISTANCE = 0.2  # [m] of a point from the surface
_MIN_RADIUS_RATIO = 0.2  # to the radius at the start: a smaller ball has collapsed
_REFINED_SIGMAS = (0.02, 0.001)  # [m] of the old surface: at first no part of it counts as an outlier
_MAX_REFINED_RMS = 0.001  # [m] between the surfaces of few and of many balls

ROUNDS = 30, (1, 5)
"""Rounds and `coarse` with which `fit_subject` fits radii of metaballs: points are matched again after every step.
With several steps in a round, radii adapt to matches that change with the poses in the next round. They end in another
minimum, as in two of four arms."""


@dataclass(frozen=True, eq=False)
class MetaballShape(Parameters):
    """Logarithms of the radii of a body's metaballs, and optionally of their weights, limb by limb.

    Parameters
    ----------
    body : Body with metaballs
    weights : whether weights are fitted too: sharper edges
    girth : standard deviation of a radius' logarithm

    Raises
    ------
    BodyError
        The body has no metaballs.
    """

    body: Body
    weights: bool = False
    girth: float = RADIUS_STD
    difference = 1e-3

    def __post_init__(self) -> None:
        if not self._limbs:
            problem = f"body '{self.body.name}' has no metaballs"
            raise BodyError(problem, remedy="Give its segments a `surface` of balls.")

    @cached_property
    def _limbs(self) -> tuple[tuple[int, Metaballs], ...]:
        """Number of the surface, and the limb, for all limbs of metaballs."""
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
        """(p,) for each parameter the segment that it changes."""
        each = [(limb.segment, len(limb.radii) * (3 + self.weights)) for _, limb in self._limbs]
        return tuple(frozenset((segment,)) for segment, count in each for _ in range(count))

    @property
    def information(self) -> NDArray:
        """(p, p) prior information."""
        std = [_WEIGHT_STD if name.endswith("weight") else self.girth for name in self.names]
        return np.diag(np.array(std) ** -2.0)

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these logarithms (p,) of factors on radii and weights."""
        surfaces, first = list(world.body.surfaces), 0
        for k, _ in self._limbs:
            limb = surfaces[k]
            assert isinstance(limb, Metaballs)
            count = len(limb.radii) * (3 + self.weights)
            surfaces[k] = _grown(limb, np.asarray(values[first : first + count], float).tobytes(), self.weights)
            first += count
        return replace(world, body=replace(world.body, surfaces=tuple(surfaces)))


def grown(limb: Metaballs, values: NDArray, *, weights: bool = False) -> Metaballs:
    """A limb with its radii and weights multiplied by factors.

    Parameters
    ----------
    values : (3 K,) logarithms of factors on radii, with `weights` followed by (K,) on weights
    """
    radii, w = _scaled(limb, values, weights)
    return limb.changed(radii, w if weights else None)


def _scaled(limb: Metaballs, values: NDArray, weights: bool) -> tuple[NDArray, NDArray]:
    """Radii (K, 3) [m] and weights (K,)."""
    count = limb.radii.size
    w = limb.weights * np.exp(values[count:]) if weights else limb.weights
    return limb.radii * np.exp(values[:count]).reshape(-1, 3), w


@lru_cache(maxsize=64)
def _grown(limb: Metaballs, values: bytes, weights: bool) -> Metaballs:
    """As `grown`, cached: finite differences change one limb at a time, and the others need no new mesh."""
    return grown(limb, np.frombuffer(values), weights=weights)


@dataclass(frozen=True, eq=False)
class BallFit:
    """A limb fitted to points.

    Parameters
    ----------
    limb : Metaballs
    std : (p,) standard deviations of the logarithms of radii (3 K), and of weights (K) if fitted
    rms : float [m] of the points' distances
    iterations : int
    """

    limb: Metaballs
    std: NDArray
    rms: float
    iterations: int


def fit_balls(
    limb: Metaballs, x: ArrayLike, sigma: ArrayLike, *, weights: bool = False, girth: float = RADIUS_STD
) -> BallFit:
    """Fit radii, and optionally weights, of a limb to points on its surface by robust least squares (Huber).

    A residual is the distance [m] of a point from the surface, where the field is 1/2. It is not the field itself as in
    P4, eq. 15 (`fit_field`). Its derivatives by radii and weights are exact: (∂F/∂p) / |∇F| at the nearest point of the
    surface.

    Parameters
    ----------
    limb : Metaballs, whose radii are the prior mean
    x : (N, 3) [m] points in the segment's frame
    sigma : (N,) or scalar, [m] standard deviations
    weights : whether weights are fitted too
    girth : prior standard deviation of a radius' logarithm, unitless

    Raises
    ------
    ObservationError
        Fewer points than parameters; points not of shape (N, 3) or not finite; standard deviations not above 0.
    BodyError
        A ball collapses: its radius falls below a fifth of its start.
    """
    x = np.asarray(x, float)
    s = np.broadcast_to(np.asarray(sigma, float), len(x))
    count = limb.radii.size + len(limb.weights) * weights
    if x.ndim != 2 or x.shape[1:] != (3,) or len(x) < count or not np.isfinite(x).all() or not (s > 0).all():
        problem = f"points of shape {x.shape} do not determine the limb's {count} parameters"
        raise ObservationError(problem, remedy=f"Give (N, 3) finite points, N >= {count}, with positive sigma.")
    prior = _prior(limb, weights, girth)
    theta, H, r, tried = _least_squares(
        lambda t: _distances(unmeshed(limb, t, weights), x, weights), np.zeros(count), prior, s**-2.0,
        huber(_HUBER_SIGMAS), limb.radii.size, np.log(_MIN_RADIUS_RATIO), _MAX_ITERATIONS,
    )  # fmt: skip
    found = grown(limb, theta, weights=weights)
    return BallFit(found, np.sqrt(np.diag(np.linalg.inv(H + np.diag(prior)))), float(np.sqrt(np.mean(r * r))), tried)


def refined(limb: Metaballs, count: int) -> Metaballs:
    """The same surface by more balls: `count` evenly from the first to the last, with radii fitted to the limb's mesh.

    A fit with three balls a limb determines the pose, the full set then the shape (P4 3.3).

    Raises
    ------
    BodyError
        No more balls than the limb has, or a limb of one ball, which states no line.
    """
    old = len(limb.centres)
    if not 1 < old < count:
        problem = f"{count} balls in place of {old}"
        raise BodyError(problem, remedy="Give more balls than the limb has, of which there are two or more.")
    at = np.linspace(0.0, old - 1.0, count)
    of, share = np.minimum(at.astype(int), old - 2), (at - np.minimum(at.astype(int), old - 2))[:, None]
    centres, radii = ((1.0 - share) * v[of] + share * v[of + 1] for v in (limb.centres, limb.radii))
    axes = limb.axes[np.rint(at).astype(int)]
    along = np.argmax(np.abs(axes @ (centres[-1] - centres[0])), axis=1)
    radii[np.arange(count), along] *= old / count
    fine = Metaballs.of(limb.segment, centres, radii, None, axes)
    for sigma in _REFINED_SIGMAS:
        found = fit_balls(fine, limb.vertices, sigma, girth=1.0)
        fine = found.limb
    if found.rms > _MAX_REFINED_RMS:
        problem = f"{count} balls do not make the limb's surface: {1e3 * found.rms:.1f} mm off"
        raise BodyError(problem, remedy="Give another number of balls.")
    return fine


def refined_body(body: Body, count: int) -> Body:
    """The body with `count` metaballs on every limb that has fewer, see `refined`.

    Raises
    ------
    BodyError
        No limb has metaballs that can be refined to so many.
    """
    found = [s for s in body.surfaces if isinstance(s, Metaballs) and 1 < len(s.centres) < count]
    if not found:
        problem = f"body '{body.name}' has no limb of two or more, and fewer than {count}, metaballs"
        raise BodyError(problem, remedy="Give a body of metaballs, such as humanoid_metaballs, and more balls.")
    return replace(body, surfaces=tuple(refined(s, count) if s in found else s for s in body.surfaces))


def fit_field(
    limb: Metaballs, x: ArrayLike, sigma: ArrayLike, values: ArrayLike, *, weights: bool = False,
    girth: float = np.inf, loss: Loss = SQUARED, iterations: int = _MAX_ITERATIONS,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Fit radii, and optionally weights, that minimise Σ p (F − 1/2)² over points (P4, eqs. 10, 14 and 15).

    F is the field of the limb at a point, and p = 1 / σ² (eq. 12). Its derivatives are exact. Steps are damped, and
    at most 0.5 in a logarithm. The defaults are as in the paper: no prior, no robust loss, no bound.

    Parameters
    ----------
    x : (N, 3) [m] points in the segment's frame
    sigma : (N,) or scalar, standard deviations of F at the points, unitless
    values : (p,) to start from: logarithms of factors on the limb's radii (3 K), then on its weights (K)
    weights : whether weights are fitted too (eq. 14); radii alone otherwise (eq. 15)
    girth : prior standard deviation of the radii's logarithms, unitless
    loss : Loss of residuals in standard deviations
    iterations : number of steps tried, at most

    Returns
    -------
    values : (p,) logarithms, as for `grown`
    std : (p,) their standard deviations
    """
    x, weight, start = np.asarray(x, float), np.asarray(sigma, float) ** -2.0, np.asarray(values, float)
    prior = _prior(limb, weights, girth)
    theta, H, _, _ = _least_squares(
        lambda t: _fields(unmeshed(limb, t, weights), x, weights), start, prior, np.broadcast_to(weight, len(x)),
        loss, limb.radii.size, -np.inf, iterations,
    )  # fmt: skip
    return theta, np.sqrt(np.diag(inverse(H + np.diag(prior))))


def _prior(limb: Metaballs, weights: bool, girth: float) -> NDArray:
    """(p,) inverse variances of the logarithms; weights have a prior if radii have one."""
    weight_std = _WEIGHT_STD if np.isfinite(girth) else np.inf
    return np.repeat([girth, weight_std], [limb.radii.size, len(limb.weights) * weights]) ** -2.0


def _least_squares(
    residuals: Callable[[NDArray], tuple[NDArray, NDArray]], theta: NDArray, prior: NDArray, weight: NDArray,
    loss: Loss, radii: int, lowest: float, iterations: int,
) -> tuple[NDArray, NDArray, NDArray, int]:  # fmt: skip
    """Levenberg-Marquardt on θ -> (J, r): final θ, normal matrix without the prior, r, number of steps tried."""
    collapsed: list[int] = []

    def at(t: NDArray) -> _Balls:
        J, r = residuals(t)
        rho, factor = loss.weigh(weight * r * r)
        w = weight * factor
        return _Balls(t, r, J.T @ (w[:, None] * J), J.T @ (w * r) - prior * t, float(rho.sum() + prior @ t**2))

    def solve(now: _Balls, damping: float) -> tuple[NDArray, float]:
        A = now.H + np.diag(prior)
        scale = damping * np.maximum(np.diag(A), 1e-12 * A.max() + 1e-300)  # a radius without influence stays
        step = np.linalg.solve(A + np.diag(scale), now.g)
        return np.clip(step, -0.5, 0.5), float(step @ (now.g + scale * step))

    def follow(now: _Balls, step: NDArray) -> _Balls | None:
        collapsed[:] = np.flatnonzero((now.theta + step)[:radii] < lowest)
        return None if collapsed else at(now.theta + step)

    end = descend(at(theta), solve, follow, iterations=iterations, tolerance=_TOLERANCE, damping=Damping(1e-3))
    if collapsed and end.damping > MAX_DAMPING:
        problem = f"ball {collapsed[0] // 3 + 1} collapses: a radius falls below {np.exp(lowest):.2g} of its start"
        raise BodyError(problem, remedy="Give points all around the limb, or fewer balls.")
    return end.at.theta, end.at.H, end.at.r, end.iterations


@dataclass(frozen=True, eq=False)
class _Balls:
    """Logarithms θ (p,), residuals (N,), normal matrix without the prior, gradient with it, and cost."""

    theta: NDArray
    r: NDArray
    H: NDArray
    g: NDArray
    cost: float


def unmeshed(limb: Metaballs, values: NDArray, weights: bool) -> Metaballs:
    """As `grown` (values (p,)), but with the old mesh: faster if only the field is needed."""
    radii, w = _scaled(limb, values, weights)
    return replace(limb, radii=radii, weights=w)


def _fields(limb: Metaballs, x: NDArray, weights: bool) -> tuple[NDArray, NDArray]:
    """(N, p) derivatives of the field by the logarithms, and (N,) residuals 1/2 − F."""
    d = limb.derivatives(x)
    J = (d.by_radii * limb.radii).reshape(len(x), -1)
    return np.concatenate([J, d.by_weights * limb.weights], axis=1) if weights else J, LEVEL - d.value


def _distances(limb: Metaballs, x: NDArray, weights: bool) -> tuple[NDArray, NDArray]:
    """(N, p) derivatives of the surface's outward motion by the logarithms, and (N,) [m] signed distances to points."""
    limbs, balls = pack_balls([limb.on(0)], np.zeros((1, 3)))
    r, normal, found = np.full(len(x), _MAX_POINT_DISTANCE), np.zeros((3, len(x))), np.full(len(x), -1)
    segment_frame = np.concatenate([np.eye(3).ravel(), np.zeros(3)])[None]
    limbs[:, 6] = np.inf  # no bounding sphere: it comes from the mesh, which has other radii
    nearest_on_metaballs(
        np.ascontiguousarray(x.T), segment_frame, limbs, balls, np.full(len(x), -1), r, normal, found
    )
    feet = (x.T - np.where(found >= 0, r, 0.0) * normal).T
    slope = np.maximum(np.linalg.norm(limb.derivatives(feet).by_point, axis=1), 1e-9)
    return np.where(found >= 0, 1.0 / slope, 0.0)[:, None] * _fields(limb, feet, weights)[0], r
