"""P4's fit of a body of metaballs to points on a surface: alternating shape and skeleton (sections 3.3 and 4).

Each observation belongs to the limb that is closest at the start (3.3), whose field should be 1/2 there (eq. 15).
Observations are weighted by their standard deviations (eq. 12), and Σ vᵀ P v over all types is minimised (eqs. 10 and
13). The minimum over the skeleton with a fixed shape and that over the shape with a fixed skeleton alternate (4.2).
`method="joint"` is kinefit's own: one fit of distances to the surface, from poses of a few rounds of the alternation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.places import nearest
from kinefit.errors import ObservationError
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.metaballs import ROUNDS, MetaballShape, fit_field, grown, unmeshed
from kinefit.geometry.camera import Rig
from kinefit.observations import PointCloud
from kinefit.papers import _metaball_steps as steps
from kinefit.papers._metaball_steps import AS_PRINTED, MetaballBody, MetaballHelps, OtherRows
from kinefit.sensors import Scene, TrackSettings
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor
from kinefit.solving.least_squares import Fit, levenberg_marquardt

_START_ROUNDS = 3  # of the alternation, before the joint fit: one arm of ten ends elsewhere without


@checked
def metaball_bodies(
    body: Body, points: Sequence[NDArray], states: Sequence[BodyState], *,
    sigma: float | Sequence[ArrayLike] = 0.001, method: Literal["alternating", "joint"] = "alternating",
    iterations: int = 30, tolerance: float = 1e-4, weights: bool = False, locked: ArrayLike | None = None,
    others: OtherRows | None = None, helps: MetaballHelps = AS_PRINTED,
) -> MetaballBody:  # fmt: skip
    """Estimate radii and poses from points on the surface in K frames.

    Parameters
    ----------
    body : Body whose segments have metaballs.
    points : K arrays (N, 3) [m] in the world, in the order of time: a pose may also start from its neighbour's.
    states : K initial poses, near enough that each point is nearest to its own limb.
    sigma : [m] standard deviation of every point, or K of them: for all points, (N,), or (N, 3, 3) covariances [m²],
        of which the component along the surface's normal at the start is used (eq. 12).
    method : "alternating" as published; "joint" minimises distances to the surface over poses and radii together.
    iterations : of the alternation: every pose to its minimum, then every limb's shape to its minimum.
    tolerance : change of poses [rad, m] and of radii (logarithm) at which it ends.
    weights : bool, whether the fields' weights are estimated too (eq. 14).
    locked : (6 + D,) bool, fixed degrees of freedom.
    others : rows of other types of observation, for the skeleton (eqs. 11 to 13).
    helps : MetaballHelps, for "alternating".

    Raises
    ------
    ObservationError
        Different numbers of frames and poses; no point near the body; arguments that "joint" does not take.
    BodyError
        A ball that collapses; balls that do not blend into one.
    """
    limbs = [s for s in body.surfaces if isinstance(s, Metaballs)]
    if len(points) != len(states) or not points or not limbs:
        problem = f"{len(points)} frames of points, {len(states)} poses, {len(limbs)} limbs of metaballs"
        raise ObservationError(problem, remedy="Give a pose for each frame, and a body such as arm_metaballs.")
    if method == "joint":
        if not isinstance(sigma, int | float) or locked is not None or others is not None or helps != AS_PRINTED:
            remedy = "Give one sigma alone, or use subject.fit.fit_subject."
            raise ObservationError("the joint fit does not accept locked, others or helps", remedy=remedy)
        return _joint(body, points, states, sigma, weights)
    fit = _Alternation(body, points, sigma, weights, locked, others, helps)
    shape, poses, std, rounds = fit.run(states, iterations, tolerance)
    found = steps.shaped_body(body, lambda limb: grown(limb, shape[limb.segment], weights=weights))
    return MetaballBody(found, tuple(poses), std, steps.rms_distance(found, poses, points), rounds)


@dataclass(frozen=True, eq=False)
class _Alternation:
    """What stays the same in the alternating fit, see `metaball_bodies`."""

    body: Body
    points: Sequence[NDArray]
    sigma: float | Sequence[ArrayLike]
    weights: bool = False
    locked: ArrayLike | None = None
    others: OtherRows | None = None
    helps: MetaballHelps = AS_PRINTED

    def run(
        self, states: Sequence[BodyState], iterations: int, tolerance: float
    ) -> tuple[dict[int, NDArray], list[BodyState], dict[str, NDArray], int]:
        """Shape by segment (logarithms), poses, standard deviations by segment, rounds."""
        body, points, helps = self.body, self.points, self.helps
        fixed = None if self.locked is None else np.asarray(self.locked, bool)
        limbs = [s for s in body.surfaces if isinstance(s, Metaballs)]
        closest = [nearest(body, s, x, max_distance=helps.max_distance) for s, x in zip(states, points)]
        of, sigmas = [n.segment for n in closest], steps.sigma_of_fields(limbs, self.sigma, [n.normal for n in closest])
        steps.check_influence(body, points, states, of)
        now, poses, std, rounds, swept = body, list(states), dict[str, NDArray](), 0, False
        shape = {limb.segment: np.zeros(limb.radii.size + len(limb.radii) * self.weights) for limb in limbs}

        def skeleton(k: int, start: BodyState) -> Fit:
            rows = partial(steps.pose_rows, now, k, points[k], of[k], sigmas[k], self.others, helps)
            return levenberg_marquardt(now, start, rows, loss=helps.loss, limits=helps.limits, locked=fixed)

        for _ in range(iterations):
            fits = [skeleton(k, pose) for k, pose in enumerate(poses)]
            if not swept:
                own, fits = fits, steps.lowest_of_neighbours(fits, skeleton)
                swept = all(a is b for a, b in zip(own, fits))
            rounds, moved = rounds + 1, max(float(np.abs(p.difference(f.state)).max()) for p, f in zip(poses, fits))
            poses = [fit.state for fit in fits]
            frames = [now.tree.forward(s.T_world_root, s.angles)[0] for s in poses]
            for limb in limbs:
                x, s = steps.points_of_limb(body, limb.segment, frames, points, of, sigmas)
                if len(x) < shape[limb.segment].size:
                    continue  # too few observations: the limb keeps its shape
                values, std[body.tree.segments[limb.segment]] = fit_field(
                    limb, x, s, shape[limb.segment], weights=self.weights, girth=helps.girth, loss=helps.loss,
                )  # fmt: skip
                moved = max(moved, float(np.abs(values - shape[limb.segment]).max()))
                shape[limb.segment] = values
            now = steps.shaped_body(body, lambda limb: unmeshed(limb, shape[limb.segment], self.weights))
            if moved < tolerance:
                break
            if helps.reassign:  # without new meshes: fields may temporarily be too weak for one
                of = [nearest(now, s, x, max_distance=helps.max_distance).segment for s, x in zip(poses, points)]
        return shape, poses, std, rounds


def _joint(
    body: Body, points: Sequence[NDArray], states: Sequence[BodyState], sigma: float, weights: bool
) -> MetaballBody:
    """Joint fit of poses and shape to distances from the surface, as for takes, from poses of the alternation."""
    states = _Alternation(body, points, sigma).run(states, _START_ROUNDS, 0.0)[1]
    sensor, shape = PointCloudSensor("points", sigma, TrackSettings()), MetaballShape(body, weights=weights)
    clouds = [PointCloud("points", 0.1 * k, x) for k, x in enumerate(points)]
    seen = [[sensor.prepare(cloud, Scene(body, s, Rig(())))] for cloud, s in zip(clouds, states)]
    found = fit_subject(body, Rig(()), seen, states, [shape], rounds=ROUNDS[0], coarse=ROUNDS[1])
    std, owner = np.sqrt(np.diag(found.covariance)), np.array([min(segments) for segments in shape.touches])
    of_limb = {body.tree.segments[k]: std[owner == k] for k in np.unique(owner)}
    off = steps.rms_distance(found.body, found.states, points)
    return MetaballBody(found.body, found.states, of_limb, off, found.rounds)
