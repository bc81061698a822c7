"""Fit limb lengths and girths to the first depth frames.

Measured points should lie on the nearest surface, and the body's contour on the person's contour in the image.
`fit_subject` finds poses of a few frames, lengths and girths jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.errors import ObservationError
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject.parameters import Parameters, SegmentScales
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.fitting.subject.surfaces import Girths
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import PointCloud
from kinefit.sensors.base import Matched, Measurement, matched_by, rows_at
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import DepthView, outside, splat, view_of
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor, SurfacePairs
from kinefit.solving.rows import AnyRows

# Chosen on ten simulated people in three postures each, with pose errors of 5° and 3 cm; the figure `size_lengths` has
# four of them.
_START_LOG_STATURES = (-0.1, 0.0, 0.1)  # closest points slide along limbs, so lengths change slowly
_ROUNDS_PER_START = 5
_ROUNDS_OF_BEST = 12
_COARSE_ITERATIONS = 1, 2  # see `fit_subject`
_INDEPENDENT_SHARE = 0.3  # of a frame's errors: neighbours share folds of cloth and the model's form
_POSTURE_PRIOR_SHARE = 0.1  # with less, poses bend to fit wrong lengths (3 of ten people, 0.5 % worse)
_CONTOUR_SIGMA_RATIO = 2.5  # to a point's: with 0.6, 1, 1.6, 2.5 lengths err by 2.5, 2.0, 2.0, 1.8 %
_MAX_CONTOUR_COSINE = 0.5  # of normal and line of sight; elsewhere moving the surface along its normal does not help
_MAX_INSIDE_COSINE = 0.25  # the same inside the contour: a sample there is within 3 % of a radius of the body's own
_INSIDE_REACH_RATIO = 0.5  # reach inside the contour; 0, 0.5, 1, 1.7 explain 70, 74, 70, 71 % of a person (Kinect)


def fit_surfaces(
    body: Body,
    clouds: Sequence[ArrayLike],
    states: Sequence[BodyState],
    *,
    camera: Camera | None = None,
    views: Sequence[DepthView] = (),
    sigma: float = 0.01,
    points: int = 500,
    start: NDArray | None = None,
) -> SubjectFit:
    """Fit lengths and girths of a body to point clouds of the person, with poses known approximately.

    Parameters
    ----------
    body : Body with surfaces; without cylinders the lengths alone are fitted
    clouds : K x (N, 3) [m] points on the person, in the world
    states : K poses
    camera : Camera of the sensor, the same for all clouds: surfaces that face away from it get no points, and empty
        pixels around the person limit the girths
    views : K views of whole depth images, instead of a camera
    sigma : float [m], standard deviation of a point: noise, cloth
    points : int, number of points used of each cloud
    start : (p,) parameters to start from, of an earlier fit; default: three statures are tried

    Returns
    -------
    SubjectFit
        Its parameters are those of `SegmentScales` and `Girths`. Unobserved ones keep the prior's standard deviation.

    Raises
    ------
    ObservationError
        No clouds, other numbers of clouds than of states, or empty ones.
    BodyError
        The body has no surfaces.
    """
    if not len(clouds) or len(clouds) != len(states):
        raise ObservationError(f"{len(clouds)} clouds but {len(states)} states", remedy="Give one state a cloud.")
    given = [x[np.isfinite(x).all(axis=1)] for x in (np.asarray(c, float).reshape(-1, 3) for c in clouds)]
    if not all(map(len, given)):
        raise ObservationError("a cloud has no points", remedy="Leave out this frame.")
    if camera is not None and not views:
        views = [_view(x, camera) for x in given]
    settings = replace(TrackSettings(), points=points)
    sensor, rng, rig = PointCloudSensor("depth", sigma, settings), np.random.default_rng(0), Rig(())
    steps: list[list[Measurement]] = []
    for k, (x, state) in enumerate(zip(given, states)):
        eye = views[k].viewpoint if views else None
        frame = PointCloud("depth", 0.0, x[rng.permutation(len(x))[:points]], on_body=True, viewpoint=eye)
        steps.append([sensor.prepare(frame, Scene(body, state, rig)), *(_Contour(v, sensor) for v in views[k : k + 1])])
    parameters: list[Parameters] = [SegmentScales(body)]
    if any(isinstance(s, TaperedCylinder) for s in body.surfaces):
        parameters.append(Girths(body))
    groups = np.arange(sum(len(p.names) for p in parameters)) < len(body.scale_groups)

    def fitted(states: Sequence[BodyState], start: NDArray, rounds: int, reach: Sequence[float]) -> SubjectFit:
        return joint.fit_subject(
            body, rig, steps, states, parameters, start=start, reach=reach, rounds=rounds,
            looks=_INDEPENDENT_SHARE * len(steps), posture=_POSTURE_PRIOR_SHARE, coarse=_COARSE_ITERATIONS,
        )  # fmt: skip

    if start is not None:
        return fitted(states, start, _ROUNDS_PER_START, joint.REACH[-1:])
    tried = [fitted(states, size * groups, _ROUNDS_PER_START, joint.REACH) for size in _START_LOG_STATURES]
    best = min(tried, key=lambda found: _misfit(found, steps))
    return fitted(best.states, best.mean, _ROUNDS_OF_BEST, joint.REACH[-1:])


def _misfit(found: SubjectFit, steps: Sequence[Sequence[Measurement]]) -> float:
    """Weight of contour samples off their place, minus that of explained points; comparable between fits."""
    total, scale = 0.0, joint.REACH[-1]
    for state, measurements in zip(found.states, steps):
        scene = Scene(found.body, state, found.rig)
        for m in measurements:
            for rows in rows_at(matched_by(m, scene, joint.REACH[0]), scene):
                explained = 1.0 / (1.0 + np.square(rows.residual / scale))
                total += float(rows.weight @ (float(isinstance(m, _Contour)) - explained))
    return total


def _view(cloud: NDArray, camera: Camera) -> DepthView:
    depth, small = splat(cloud, camera)
    return view_of(depth, depth > 0, small)


class _Contour(Measurement):
    """The person's contour in a view: the body's occluding contour should lie on it.

    Without the pull from inside the contour, the body stays too small: points beyond it are too far to be matched.
    """

    settled = False

    def __init__(self, view: DepthView, of: PointCloudSensor) -> None:
        self.sensor, self.time, self._view, self._of = "contour", 0.0, view, of

    def match(self, scene: Scene, reach: float) -> Matched:
        """Match surface samples outside the person's contour, and little inside it, to it along their normals."""
        samples, f = scene.surface.samples, scene.frames[scene.surface.samples.segment]
        R = f[:, :9].reshape(-1, 3, 3)
        x = np.einsum("nij,jn->ni", R, samples.point) + f[:, 9:]
        n = np.einsum("nij,jn->ni", R, samples.normal)
        out, trust = outside(self._view, x)
        sight = x - self._view.viewpoint
        largest = np.where(out < 0.0, _MAX_INSIDE_COSINE, _MAX_CONTOUR_COSINE)
        is_contour = np.abs(np.einsum("ni,ni->n", n, sight)) < largest * np.linalg.norm(sight, axis=1)
        is_near = (out > -_INSIDE_REACH_RATIO * reach) & (out < 2.0 * reach)
        use = is_near & (trust > 0.0) & is_contour & ~scene.surface.fingers
        place, normal = (np.ascontiguousarray(a[:, use].T) for a in (samples.point, samples.normal))
        anchors = SurfaceAnchors(scene.body, samples.segment[use], place, normal)
        patches = float(scene.surface.areas.sum()) / (self._of.settings.patch**2 * len(samples))
        weight = trust[use] * min(patches, 1.0) / (_CONTOUR_SIGMA_RATIO * self._of.sigma) ** 2
        return _Receding(SurfacePairs(anchors, x[use] - out[use, None] * n[use], weight, reach, True))


@dataclass(frozen=True, eq=False)
class _Receding(Matched):
    """Surface samples near the person's contour, paired with places on it."""

    pairs: SurfacePairs
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row for each sample."""
        return [self.pairs.rows(scene)]
