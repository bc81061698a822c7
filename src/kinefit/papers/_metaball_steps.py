"""Steps of P4's fit of metaballs: extensions of the paper, rows of a pose, weights of the points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.places import nearest
from kinefit.errors import ObservationError
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving.correspondences import field_rows, prior_rows
from kinefit.solving.least_squares import Fit
from kinefit.solving.rows import AnyRows

OtherRows = Callable[[int, Body, BodyState], Iterable[AnyRows]]
"""Rows of other types of observation, from a frame's index, the body and the pose."""

MAX_DISTANCE = 100.0  # [m] of a search without a bound


@dataclass(frozen=True)
class MetaballHelps:
    """Extensions of the paper; all are off by default.

    Parameters
    ----------
    reassign : bool, whether the closest limb of each point is searched again in every iteration.
    max_distance : float [m] from the body, beyond which a point belongs to no limb.
    loss : robust loss of residuals in standard deviations.
    girth : float, standard deviation of a prior on the radii's logarithms.
    posture : float, standard deviation of a prior on the posture, in units of that of the body.
    limits : bool, whether joints respect their limits.
    """

    reassign: bool = False
    max_distance: float = MAX_DISTANCE
    loss: Loss = SQUARED
    girth: float = np.inf
    posture: float = np.inf
    limits: bool = False


AS_PRINTED = MetaballHelps()
"""The method as published, without extensions."""


@dataclass(frozen=True, eq=False)
class MetaballBody:
    """A body of metaballs fitted to points.

    Parameters
    ----------
    body : Body with the estimated radii.
    states : K poses
    radii_std : {segment: (p,)} standard deviations of the radii's logarithms; alternating: with fixed poses.
    rms : float [m] root mean square distance of the points from the surface.
    iterations : int, of the alternation or of the joint fit.
    """

    body: Body
    states: tuple[BodyState, ...]
    radii_std: dict[str, NDArray]
    rms: float
    iterations: int


def pose_rows(
    body: Body, frame: int, x: NDArray, segment: NDArray, sigma: NDArray, others: OtherRows | None,
    helps: MetaballHelps, state: BodyState,
) -> list[AnyRows]:  # fmt: skip
    """Rows of one pose: points x (N, 3) [m] with sigma (N,) by eq. 15, other types, and the posture prior if chosen."""
    rows: list[AnyRows] = [field_rows(body, state, x, segment, sigma=sigma)]
    if np.isfinite(helps.posture):
        rows.append(prior_rows(body, state, sigma=helps.posture * body.tree.spread))
    return rows if others is None else [*rows, *others(frame, body, state)]


def sigma_of_fields(
    limbs: Sequence[Metaballs], sigma: float | Sequence[ArrayLike], normals: Sequence[NDArray]
) -> list[NDArray]:
    """Standard deviations of the field at the points, K arrays (N,), p = 1 / σ² (eq. 12).

    One slope [1/m] for the whole body converts metres to the field's unit, so that points of equal σ have equal
    weights, as published, and other types of observation keep their own units.

    Raises
    ------
    ObservationError
        Sigmas of another number or shape, or not positive.
    """
    slopes = np.concatenate([np.sum(limb.derivatives(limb.vertices).by_point ** 2, axis=1) for limb in limbs])
    out, each = [], [sigma] * len(normals) if isinstance(sigma, int | float) else sigma
    if len(each) != len(normals):
        problem = f"standard deviations of {len(each)} frames for {len(normals)}"
        raise ObservationError(problem, remedy="Give one number, or an array for each frame.")
    for s, n in zip((np.asarray(s, float) for s in each), normals):
        if s.shape == (len(n), 3, 3):  # points out of reach at the start have no normal
            mean = np.trace(s, axis1=1, axis2=2) / 3.0
            s = np.sqrt(np.where(n.any(axis=1), np.einsum("ni,nij,nj->n", n, s, n), mean))
        if s.shape not in ((), (len(n),)) or not (s > 0).all():
            problem = f"standard deviations of shape {s.shape}, or not positive, for {len(n)} points"
            raise ObservationError(problem, remedy="Give positive ones (N,), or covariances (N, 3, 3).")
        out.append(np.sqrt(slopes.mean()) * np.broadcast_to(s, len(n)))
    return out


def points_of_limb(
    body: Body, segment: int, frames: Sequence[NDArray], points: Sequence[NDArray], of: Sequence[NDArray],
    sigmas: Sequence[NDArray],
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Points (N, 3) [m] of a limb in its segment's frame, and their standard deviations (N,), of all frames."""
    x = [(x[o == segment] - f[segment, 9:]) @ f[segment, :9].reshape(3, 3) for f, x, o in zip(frames, points, of)]
    return np.concatenate(x) - body.tree.rest[segment], np.concatenate([s[o == segment] for s, o in zip(sigmas, of)])


def shaped_body(body: Body, shaped: Callable[[Metaballs], Metaballs]) -> Body:
    """Replace the metaballs of a body."""
    return replace(body, surfaces=tuple(shaped(s) if isinstance(s, Metaballs) else s for s in body.surfaces))


def rms_distance(body: Body, states: Sequence[BodyState], points: Sequence[NDArray]) -> float:
    """Root mean square distance [m] of all points, K arrays (N, 3) [m], from the surface."""
    far = [nearest(body, s, x, max_distance=MAX_DISTANCE).distance for s, x in zip(states, points)]
    return float(np.sqrt(np.mean(np.concatenate(far) ** 2)))


def check_influence(
    body: Body, points: Sequence[NDArray], states: Sequence[BodyState], of: Sequence[NDArray]
) -> None:
    """Raise ObservationError if all points, K arrays (N, 3) [m], are too far away for a gradient of the field."""
    first = [field_rows(body, s, x, o) for s, x, o in zip(states, points, of)]
    if not any(np.abs(rows.direction).max(initial=0.0) > 1e-9 for rows in first):
        raise ObservationError("no point lies near the body", remedy="Start nearer; check the unit and the world.")


def lowest_of_neighbours(fits: list[Fit], skeleton: Callable[[int, BodyState], Fit]) -> list[Fit]:
    """Fit each frame from its neighbours' poses too, forwards and backwards in time, and keep the lowest cost."""
    out = list(fits)
    forwards = [(k - 1, k) for k in range(1, len(out))]
    for a, b in [*forwards, *((b, a) for a, b in reversed(forwards))]:
        out[b] = min(out[b], skeleton(b, out[a].state), key=lambda fit: fit.equations.cost)
    return out
