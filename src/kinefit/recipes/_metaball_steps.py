"""Steps of P4's fit of metaballs: what the paper does not have, rows of a pose, weights of the points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import Metaballs, nearest
from kinefit.correspondences import field_rows
from kinefit.correspondences.parameters import prior_rows
from kinefit.errors import ObservationError
from kinefit.losses import SQUARED, Loss
from kinefit.rows import AnyRows

OtherRows = Callable[[int, Body, BodyState], Iterable[AnyRows]]
"""Rows of other types of observation: of a frame's number, the body and the pose."""

MAX_DISTANCE = 100.0  # [m] of a search that is to have no bound


@dataclass(frozen=True)
class MetaballHelps:
    """What the paper does not have; all of it is off by default.

    Parameters
    ----------
    reassign : whether the closest limb of each point is searched for again in every iteration.
    max_distance : [m] from the body, beyond which a point belongs to no limb.
    loss : robust loss of residuals in standard deviations.
    girth : standard deviation of a prior on the radii's logarithms.
    posture : standard deviation of a prior on the posture, in those of the body's own.
    limits : whether joints keep to their limits.
    """

    reassign: bool = False
    max_distance: float = MAX_DISTANCE
    loss: Loss = SQUARED
    girth: float = np.inf
    posture: float = np.inf
    limits: bool = False


AS_PRINTED = MetaballHelps()
"""No help."""


def pose_rows(
    body: Body, frame: int, x: NDArray, segment: NDArray, sigma: NDArray, others: OtherRows | None,
    helps: MetaballHelps, state: BodyState,
) -> list[AnyRows]:  # fmt: skip
    """Of one pose: points of the type of eq. 15, other types, and the prior that is a help."""
    rows: list[AnyRows] = [field_rows(body, state, x, segment, sigma=sigma)]
    if np.isfinite(helps.posture):
        rows.append(prior_rows(body, state, sigma=helps.posture * body.tree.spread))
    return rows if others is None else [*rows, *others(frame, body, state)]


def sigma_of_fields(
    limbs: Sequence[Metaballs], sigma: float | Sequence[ArrayLike], normals: Sequence[NDArray]
) -> list[NDArray]:
    """K arrays (N,): standard deviations of the field at the points, p = 1 / σ² (eq. 12).

    One slope [1/m] for the whole body turns metres into the field's unit, so that points of one σ have one weight, as
    printed, and other types of observation are weighed in their own units.
    """
    slopes = np.concatenate([np.sum(limb.derivatives(limb.vertices).by_point ** 2, axis=1) for limb in limbs])
    out, each = [], [sigma] * len(normals) if isinstance(sigma, int | float) else sigma
    if len(each) != len(normals):
        problem = f"standard deviations of {len(each)} frames for {len(normals)}"
        raise ObservationError(problem, remedy="Give one number, or an array for each frame.")
    for s, n in zip((np.asarray(s, float) for s in each), normals):
        if s.shape == (len(n), 3, 3):  # a point that is beyond reach at the start has no normal
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
    """Points (N, 3) of a limb in its segment's frame, and their standard deviations (N,), of all frames."""
    x = [(x[o == segment] - f[segment, 9:]) @ f[segment, :9].reshape(3, 3) for f, x, o in zip(frames, points, of)]
    return np.concatenate(x) - body.tree.rest[segment], np.concatenate([s[o == segment] for s, o in zip(sigmas, of)])


def shaped_body(body: Body, shaped: Callable[[Metaballs], Metaballs]) -> Body:
    """A body with other metaballs."""
    return replace(body, surfaces=tuple(shaped(s) if isinstance(s, Metaballs) else s for s in body.surfaces))


def rms_distance(body: Body, states: Sequence[BodyState], points: Sequence[NDArray]) -> float:
    """[m] distance of all points from the surface."""
    far = [nearest(body, s, x, max_distance=MAX_DISTANCE).distance for s, x in zip(states, points)]
    return float(np.sqrt(np.mean(np.concatenate(far) ** 2)))


def check_influence(
    body: Body, points: Sequence[NDArray], states: Sequence[BodyState], of: Sequence[NDArray]
) -> None:
    """Refuse points that are all so far away that their fields have no slope."""
    first = [field_rows(body, s, x, o) for s, x, o in zip(states, points, of)]
    if not any(np.abs(rows.direction).max(initial=0.0) > 1e-9 for rows in first):
        raise ObservationError("no point lies near the body", remedy="Begin nearer; check the unit and the world.")
