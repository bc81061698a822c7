"""P4's fit of a body of metaballs to points on a surface: shape and skeleton in turn (sections 3.3 and 4).

Observations belong to the closest limb, weigh by their standard deviations (eq. 12), and ask that the limb's field is
1/2 there (eq. 15). The skeleton's step moves all poses with the shape held, the shape's step all radii with the poses
held; the paper found this to converge better than both at once. Both at once, beside any other sensor, is
`subject.fit.fit_subject` with `MetaballShape`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import Metaballs, nearest
from kinefit.correspondences import surface_rows
from kinefit.correspondences.parameters import prior_rows
from kinefit.errors import ObservationError
from kinefit.losses import huber
from kinefit.rows import AnyRows
from kinefit.solvers.least_squares import gauss_newton
from kinefit.subject.metaballs import fit_balls

_REACH = 0.1  # [m] farther from every limb a point is of something else
_POSES = 4  # steps of the skeleton between two of the shape: by more, poses follow radii that are wrong
_POSTURE = 20.0  # times the spread of the body's posture prior: it holds what no point tells, and nothing else


@dataclass(frozen=True, eq=False)
class MetaballBody:
    """A body of metaballs fitted to points.

    Parameters
    ----------
    body : Body with the radii found.
    states : K poses
    radii_std : {segment: (p,)} standard deviations of the radii's logarithms, poses taken for known.
    rms : float [m] distance of the points from the surface.
    iterations : int, of both steps.
    """

    body: Body
    states: tuple[BodyState, ...]
    radii_std: dict[str, NDArray]
    rms: float
    iterations: int


@checked
def metaball_bodies(
    body: Body, points: Sequence[NDArray], states: Sequence[BodyState], *, sigma: float = 0.001, iterations: int = 30,
    tolerance: float = 1e-4, weights: bool = False, locked: ArrayLike | None = None,
) -> MetaballBody:  # fmt: skip
    """Radii and poses from points on the surface in K frames.

    Parameters
    ----------
    body : Body whose segments have metaballs.
    points : K arrays (N, 3) [m] in the world.
    states : K poses to begin with, near enough that each point is nearest to its own limb.
    sigma : [m] standard deviation of a point.
    tolerance : change of poses [rad, m] and of radii (logarithm) below which it ends.
    weights : whether the fields' weights are sought too.
    locked : (6 + D,) bool, degrees of freedom that stay.

    Raises
    ------
    ObservationError
        As many frames of points as poses are wanted; points of which none is near the body.
    BodyError
        A ball that collapses.
    """
    limbs = [k for k, s in enumerate(body.surfaces) if isinstance(s, Metaballs)]
    if len(points) != len(states) or not points or not limbs:
        problem = f"{len(points)} frames of points, {len(states)} poses, {len(limbs)} limbs of metaballs"
        raise ObservationError(problem, remedy="Give a pose for each frame, and a body such as arm_metaballs.")
    held = None if locked is None else np.asarray(locked, bool)
    poses, std = list(states), dict[str, NDArray]()
    rms, rounds, generic = np.inf, 0, body
    for _ in range(iterations):
        rounds += 1
        of = [nearest(body, s, x, max_distance=_REACH).segment for s, x in zip(poses, points)]
        if all((o < 0).all() for o in of):
            raise ObservationError("no point lies near the body", remedy="Begin nearer; check the unit and the world.")
        moved = 0.0
        for k, x in enumerate(points):
            for _step in range(_POSES):
                near = x[of[k] >= 0]
                rows: list[AnyRows] = [
                    surface_rows(body, poses[k], near, max_distance=_REACH, sigma=sigma, segment=of[k][of[k] >= 0]),
                    prior_rows(body, poses[k], sigma=_POSTURE * body.tree.spread),
                ]
                step = gauss_newton(body, poses[k], rows, loss=huber(3.0), locked=held)
                poses[k] = step.state
                moved = max(moved, float(np.abs(step.delta).max()))
                if step.norm < tolerance:
                    break
        surfaces, grown, squares, count = list(body.surfaces), 0.0, 0.0, 0
        for i in limbs:
            limb = surfaces[i]
            assert isinstance(limb, Metaballs)
            x_segment = np.concatenate([_in_segment(body, s, x[o == limb.segment], limb.segment)
                                        for s, x, o in zip(poses, points, of)])  # fmt: skip
            if len(x_segment) < 2 * limb.radii.size:
                continue  # too little is seen of it: it stays as it is
            found = fit_balls(generic.surfaces[i], x_segment, sigma, weights=weights)  # type: ignore[arg-type]
            std[body.tree.segments[limb.segment]] = found.std
            grown = max(grown, float(np.abs(np.log(found.limb.radii / limb.radii)).max()))
            squares, count = squares + found.rms**2 * len(x_segment), count + len(x_segment)
            surfaces[i] = found.limb
        body = replace(body, surfaces=tuple(surfaces))
        rms = float(np.sqrt(squares / max(count, 1)))
        if max(moved, grown) < tolerance:
            break
    return MetaballBody(body, tuple(poses), std, rms, rounds)


def _in_segment(body: Body, state: BodyState, x: NDArray, segment: int) -> NDArray:
    """Points (N, 3) of the world in a segment's frame."""
    f = body.tree.forward(state.T_world_root, state.angles)[0][segment]
    return (x - f[9:]) @ f[:9].reshape(3, 3) - body.tree.rest[segment]
