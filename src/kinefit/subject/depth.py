"""The person's own size from the first depth frames: lengths of the limbs and girths of the surfaces.

Measured points should lie on the surface nearest to them, and no contour of the body should stand out where the sensor
saw past it; `fit_subject` finds the poses of a few frames, lengths and girths together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import SurfaceAnchors, TaperedCylinder
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import PointCloud
from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched, Measurement, matched_by, rows_at
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import DepthView, outside, splat, view_of
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor
from kinefit.sensors.surfaces.surface_match import SurfacePairs
from kinefit.subject import fit as joint
from kinefit.subject.parameters import Parameters, SegmentScales
from kinefit.subject.subject import SubjectFit
from kinefit.subject.surfaces import Girths

# Chosen on ten simulated people in three postures each, off by 5° and 3 cm; the figure `size_lengths` has four of them.
_STATURES = (-0.1, 0.0, 0.1)  # logarithms to start from: closest points slide along limbs, lengths are slow to change
_TRIED, _ROUNDS = 5, 12  # rounds with each, and with the best of them
_COARSE = 1, 2  # as of `fit_subject`
_LOOKS = 0.3  # of a frame, independent: neighbours share folds of cloth and the model's form
_POSTURE = 0.1  # share of the posture prior: lengths that poses are bent for are worse (3 of ten people by 0.5 %)
_CONTOUR = 2.5  # times a point's standard deviation: of 0.6, 1, 1.6, 2.5 lengths are off by 2.5, 2.0, 2.0, 1.8 %
_ACROSS = 0.5  # cosine of normal and line of sight; elsewhere a surface that recedes does not help


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
    """Lengths and girths of a body from clouds of the person in poses that are about known.

    Parameters
    ----------
    body : Body with surfaces; of one without cylinders the lengths alone are found.
    clouds : K x (N, 3) [m] points on the person, in the world
    states : K poses
    camera : Camera of the sensor, one for all: surfaces that face away from it attract nothing, and what its image
        shows empty about the person holds the girths from growing
    views : K, the same from whole depth images, instead of a camera
    sigma : float [m], of a point: noise, cloth
    points : int of each cloud that take part
    start : (p,) parameters to start from, of an earlier fit; default: three statures are tried

    Returns
    -------
    Subject
        Its parameters are those of `SegmentScales` and `Girths`; their standard deviations are as wide as the prior's
        where nothing was seen.

    Raises
    ------
    ObservationError
        No clouds, other numbers of clouds than of states, or empty ones.
    BodyError
        The body has no surfaces.
    """
    if not len(clouds) or len(clouds) != len(states):
        raise ObservationError(f"{len(clouds)} clouds with {len(states)} states", remedy="Give one state a cloud.")
    given = [x[np.isfinite(x).all(axis=1)] for x in (np.asarray(c, float).reshape(-1, 3) for c in clouds)]
    if not all(map(len, given)):
        raise ObservationError("a cloud without points", remedy="Leave that frame out.")
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
            body, rig, steps, states, parameters, start=start, reach=reach, rounds=rounds, looks=_LOOKS * len(steps),
            posture=_POSTURE, coarse=_COARSE,
        )  # fmt: skip

    if start is not None:
        return fitted(states, start, _TRIED, joint.REACH[-1:])
    tried = [fitted(states, stature * groups, _TRIED, joint.REACH) for stature in _STATURES]
    best = min(tried, key=lambda found: _misfit(found, steps))
    return fitted(best.states, best.mean, _ROUNDS, joint.REACH[-1:])


def _misfit(found: SubjectFit, steps: Sequence[Sequence[Measurement]]) -> float:
    """What stands out, less the points that the body explains; alike for fits with other correspondences."""
    total, soft = 0.0, joint.REACH[-1]
    for state, several in zip(found.states, steps):
        scene = Scene(found.body, state, found.rig)
        for one in several:
            for rows in rows_at(matched_by(one, scene, joint.REACH[0]), scene):
                explained = 1.0 / (1.0 + np.square(rows.residual / soft))
                total += float(rows.weight @ (float(isinstance(one, _Contour)) - explained))
    return total


def _view(cloud: NDArray, camera: Camera) -> DepthView:
    depth, small = splat(cloud, camera)
    return view_of(depth, depth > 0, small)


class _Contour(Measurement):
    """What a view shows empty: the body's occluding contour should recede to the person's outline in it."""

    settled = False

    def __init__(self, view: DepthView, of: PointCloudSensor) -> None:
        self.sensor, self.time, self._view, self._of = "contour", 0.0, view, of

    def match(self, scene: Scene, reach: float) -> Matched:
        """Samples of the surface beside the outline, each with the place at it that lies along its normal."""
        samples, f = scene.surface.samples, scene.frames[scene.surface.samples.segment]
        R = f[:, :9].reshape(-1, 3, 3)
        x = np.einsum("nij,jn->ni", R, samples.point) + f[:, 9:]
        n = np.einsum("nij,jn->ni", R, samples.normal)
        out, trust = outside(self._view, x)
        sight = x - self._view.viewpoint
        across = np.abs(np.einsum("ni,ni->n", n, sight)) < _ACROSS * np.linalg.norm(sight, axis=1)
        use = (out > 0.0) & (out < 2.0 * reach) & (trust > 0.0) & across & ~scene.surface.fingers
        place, normal = (np.ascontiguousarray(a[:, use].T) for a in (samples.point, samples.normal))
        anchors = SurfaceAnchors(scene.body, samples.segment[use], place, normal)
        patches = float(scene.surface.areas.sum()) / (self._of.settings.patch**2 * len(samples))
        weight = trust[use] * min(patches, 1.0) / (_CONTOUR * self._of.sigma) ** 2
        return _Receding(SurfacePairs(anchors, x[use] - out[use, None] * n[use], weight, reach, True))


@dataclass(frozen=True, eq=False)
class _Receding(Matched):
    """Samples of the surface that stand out, and where they should be."""

    pairs: SurfacePairs
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a sample."""
        return [self.pairs.rows(scene)]
