"""Candidate states of a body without an initial pose: from markers, keypoints, depth images, or rays.

Rays, such as those of one camera's keypoints, give a start together with another sensor's rows.

Fit silhouettes from a distant pose, coarse to fine in image, correspondences, normals and surface (P1 2.4).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.limbs import limbs
from kinefit.errors import KinefitError, ObservationError, TrackingError
from kinefit.fitting.frame.fit import FrameFit
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.initialization.depth_search import PostureSearch, towards
from kinefit.fitting.initialization.from_depth import Start, StartSearch, starts_by_attempt
from kinefit.fitting.initialization.from_points import pose_from_points
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import DepthFrame, PointCloud, SilhouetteFrame, by_record
from kinefit.sensors.base import Measurement
from kinefit.sensors.channels import joined
from kinefit.sensors.regions.silhouette import SilhouetteMeasurement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import camera_at
from kinefit.sensors.visibility.occlusion import without_others
from kinefit.sensors.visibility.visibility import TrackedSurface
from kinefit.solving.correspondences import prior_rows
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.rows import AnyRows

MIN_GAIN = 0.01  # of the score (share of the person's pixels) by which another pose must be better
LEAP = 0.05  # the same for a limb that moves elsewhere: about the share of a forearm ...
MIN_LOST_GAIN = 0.02  # ... or of a hand, where the limb is lost: nothing speaks for its place


def starts_from_points(
    body: Body, measurements: Sequence[Measurement], scene: Scene, up: NDArray, *, rays: bool = True
) -> list[BodyState]:
    """Initial states from six or more points known in space: markers, or keypoints of several cameras.

    With fewer points, the states follow from the rays of one camera's keypoints if there is another sensor.

    Parameters
    ----------
    measurements : of all sensors with named points
    scene : of the body, in any state
    up : (3,) unit vector, upwards in the world
    rays : whether to use rays, which needs several fits
    """
    given = [m for m in measurements if m.settled]
    points, x, directions = known_points(given, scene)
    if np.isfinite(x).all(axis=1).sum() < 6:
        return starts_from_rays(scene, points, directions, given, up) if rays and len(given) > 1 else []
    try:
        return [pose_from_points(body, points, x)[0]]
    except TrackingError:
        return []


def starts_from_views(
    scene: Scene, frames: Sequence[Any], up: NDArray, measurements: Sequence[Measurement], count: int = 3, *,
    backgrounds: Mapping[str, NDArray] | None = None, forward: NDArray | None = None,
) -> Iterator[list[BodyState]]:  # fmt: skip
    """Yield initial states from one depth image or cloud, attempt by attempt, those nearest to known points first.

    Parameters
    ----------
    frames : of all sensors at one time
    up : (3,) unit vector, upwards in the world
    measurements : with named points, for the order
    count : most states per attempt
    backgrounds : (H, W) [m] depth of the empty scene, by depth camera; default: unknown
    forward : (3,) direction in which the body faced before; default: unknown
    """
    points, x, _ = known_points(measurements, scene)
    known = np.isfinite(x).all(axis=1)

    def distance_of(start: Start) -> float:
        return float(np.median(np.linalg.norm(scene.body.positions(start.state, points)[known] - x[known], axis=1)))

    for view in _views(scene, frames):
        empty = (backgrounds or {}).get(view[1].name)
        with suppress(KinefitError):
            search = StartSearch(count, forward=forward)
            for starts in starts_by_attempt(scene.body, *view, background=empty, up=up, search=search):
                if known.any():
                    starts.sort(key=distance_of)
                yield [start.state for start in starts]
            return


def known_points(measurements: Sequence[Measurement], scene: Scene) -> tuple[PointSet, NDArray, NDArray]:
    """Points of the body in all measurements, with positions (K, 3) [m] and rays (K, 2, 3); NaN where unknown."""
    sets, places, rays = [], [np.zeros((0, 3))], [np.zeros((0, 2, 3))]
    for m in (m for m in measurements if m.settled):  # surfaces have no named points
        hints = m.hints(scene)
        if hints.points is None:
            continue
        names = tuple(f"{m.sensor}/{name}" for name in hints.points.names)
        sets.append(PointSet(names, hints.points.segments, hints.points.points))
        places.append(np.full((len(names), 3), np.nan) if hints.x_world is None else hints.x_world)
        rays.append(np.full((len(names), 2, 3), np.nan) if hints.rays is None else hints.rays)
    empty = PointSet((), np.empty(0, np.int64), np.empty((0, 3)))
    return (joined(sets) if sets else empty), np.concatenate(places), np.concatenate(rays)


def find_limbs(
    search: PostureSearch, state: BodyState, seek: NDArray, lost: NDArray, tries: int = 200
) -> list[tuple[BodyState, float]]:
    """Search a view for better poses of some limbs: states with the gain in score that each must exceed.

    First the limbs, then the whole body are moved locally. A limb found elsewhere must gain `LEAP`,
    a lost one `MIN_LOST_GAIN`.

    Parameters
    ----------
    seek, lost : (S,) bool, segments whose whole limbs are searched, and those of them that are lost
    tries : number of random poses per limb
    """
    current_score, ends = search.score.of(state), search.ends(state)
    is_lost = [bool(lost[list(limb)].any()) for limb in search.limbs]
    limb_dofs = np.flatnonzero(dofs_of_limbs(search.body, seek))
    near, value = search.polish(state, None, limb_dofs, 6, 48, 1.5) if len(limb_dofs) else (state, float(current_score))
    whole, whole_value = search.polish(near, None, np.arange(search.body.tree.n_dofs), 8, 40, 0.6)
    out = [(near, value - current_score, MIN_GAIN), (whole, whole_value - current_score, MIN_GAIN)]
    found = [(state, current_score)]
    for least, of_lost in ((MIN_LOST_GAIN, True), (LEAP, False)):
        sought = [limb for limb, one in zip(search.limbs, is_lost) if one == of_lost and seek[list(limb)].any()]
        for limb in sought:
            found = search.limb(found[0][0], limb, None, ends, tries)
        if sought:
            out += [(s, v - current_score, least) for s, v in found[:2]]
    return [(s, min_gain) for s, gain, min_gain in sorted(out, key=lambda o: o[2] - o[1]) if gain > min_gain]


def dofs_of_limbs(body: Body, lost: NDArray) -> NDArray:
    """(6 + D,) bool: degrees of freedom of all limbs with a lost segment; lost (S,) bool."""
    segments = {s for limb in limbs(body) if lost[list(limb)].any() for s in limb}
    return np.concatenate([np.zeros(6, bool), np.isin(body.tree.owners, sorted(segments))])


def _views(scene: Scene, frames: Sequence[Any]) -> Iterator[tuple[NDArray | None, Camera, NDArray | None]]:
    """Points, camera and image of all depth sensors, without the other bodies of the scene."""
    records = by_record(frames)
    for frame in records[DepthFrame]:
        camera = scene.rig[frame.sensor]
        yield None, camera, without_others(frame, scene.others, camera).depth
    for cloud in records[PointCloud]:
        if cloud.on_body and cloud.segment is None and len(cloud):
            yield cloud.points, camera_at(cloud.points, cloud.viewpoint), None


_HEADING_COUNT = 4
"""Initial headings about the vertical: a fit reaches minima within 45 degrees."""

_MIN_POINTS = 6
_MAX_ITERATIONS = 60
_TOLERANCE = 1e-4


def starts_from_rays(
    scene: Scene, points: PointSet, rays: NDArray, measurements: Sequence[Measurement], up: NDArray
) -> list[BodyState]:
    """States that fit all measurements, in order of increasing cost; empty with fewer than six rays.

    The body starts upright on the mean ray, at the distance given by its size on the rays, with several headings. The
    rows of all measurements then decide. Rays alone cannot distinguish a smaller, nearer body; a range or contact can.

    Parameters
    ----------
    scene : of the body, in any state
    points : K points of the body
    rays : (K, 2, 3) origin [m] and unit direction, in the world, of each point's ray; NaN where unknown
    measurements : all their rows are used
    up : (3,) unit vector, upwards in the world
    """
    known = np.isfinite(rays).all(axis=(1, 2))
    if known.sum() < _MIN_POINTS:
        return []
    body, (origin, direction) = scene.body, rays[known].swapaxes(0, 1)
    rest = body.positions(body.default_state(np.eye(4)), points)[known]
    axis = direction.mean(axis=0)
    axis /= np.linalg.norm(axis)
    angle = np.sqrt(np.mean(np.sum(np.square(direction - axis), axis=1)))

    def rows(state: BodyState) -> list[AnyRows]:
        scene_at = scene.at(state, measurements=tuple(measurements))
        return [*(r for m in measurements for r in m.match(scene_at, np.inf).rows(scene_at)), prior_rows(body, state)]

    fits = []
    for heading in _headings(axis, up):
        R = np.stack([heading, up, np.cross(heading, up)], axis=1)
        x = rest @ R.T
        across = (x - x.mean(axis=0)) @ (np.eye(3) - np.outer(axis, axis))
        distance = np.sqrt(np.mean(np.sum(np.square(across), axis=1))) / max(angle, 1e-6)
        start = body.default_state(se3.transform(R, origin.mean(axis=0) + distance * axis - x.mean(axis=0)))
        fits.append(levenberg_marquardt(body, start, rows, max_iterations=_MAX_ITERATIONS, tolerance=_TOLERANCE))
    return [fit.state for fit in sorted(fits, key=lambda fit: fit.equations.cost)]


def _headings(axis: NDArray, up: NDArray) -> list[NDArray]:
    """(3,) horizontal unit vectors, the first towards the camera."""
    forward = towards(axis, up)
    side = np.cross(up, forward)
    return [np.cos(a) * forward + np.sin(a) * side for a in 2.0 * np.pi * np.arange(_HEADING_COUNT) / _HEADING_COUNT]


class Level(NamedTuple):
    """One level of the coarse-to-fine fit.

    Parameters
    ----------
    side : [px] longer side of the image in which contours are compared
    far, near : [m] correspondence distance in the first and in the last iteration
    angle : [rad] largest angle between the normals of a pair
    """

    side: int
    far: float
    near: float
    angle: float


LEVELS = (Level(40, 0.8, 0.4, 1.5), Level(80, 0.5, 0.2, 1.4), Level(160, 0.3, 0.1, 1.2), Level(320, 0.15, 0.03, 1.0))
_MIN_OVERLAP_GAIN = 0.01  # of a coarser start: contours of one pose differ by that between levels
_ITERATION_FACTOR = 3  # on the iterations per frame of a sequence


class FarFit(NamedTuple):
    """Result of the coarse-to-fine fit, and its overlap (0 to 1) with the silhouettes (mean IoU)."""

    result: FrameResult
    overlap: float


def coarse_to_fine(
    body: Body, rig: Rig, frames: Sequence[SilhouetteFrame], state: BodyState, *,
    sigma: Mapping[str, float] | None = None, levels: Sequence[Level] = LEVELS,
    low_pass: bool = True, settings: TrackSettings | None = None,
) -> FarFit:  # fmt: skip
    """Fit silhouettes of one time from a pose that may be tens of degrees off in every joint.

    Coarse levels have a large basin of attraction, but may lose a close pose. So the fit starts at every level in turn,
    with and without low-pass approximations of the surface. The result with the largest overlap is returned.

    Parameters
    ----------
    frames : silhouettes, one or more
    sigma : [px] standard deviations by "silhouette CAMERA"; default: the settings'
    levels : from coarse to fine; the last one is what the tracker does between frames
    low_pass : whether to try low-pass approximations of the body's surface too (`Morphing.levels`, P1 2.4)

    Raises
    ------
    ObservationError
        There are no silhouettes or no levels.
    """
    if not frames or not levels:
        raise ObservationError("no silhouettes to fit, or no levels", remedy="Give silhouettes of one camera or more.")
    settings = settings or TrackSettings()
    level_settings = [
        replace(
            settings, outline=level.side, far=level.far, near=level.near, angle=level.angle,
            iterations=settings.iterations * _ITERATION_FACTOR,
        )
        for level in levels
    ]  # fmt: skip
    whole = TrackedSurface(body, settings.samples)
    fits = [(FrameFit(body, own), Sensors(rig, 1.0, dict(sigma or {}), own)) for own in level_settings]
    full_scenes = [Scene(body, state, rig, samples=settings.samples, surface=whole)] * len(levels)
    chains = [(first, full_scenes) for first in range(len(levels) - 1, -1, -1)]
    if low_pass:
        surfaces = [whole.with_shape(shape) for shape in whole.morphing.levels(len(levels))]
        smooth = [Scene(body, state, rig, samples=settings.samples, surface=surface) for surface in surfaces]
        chains += [(first, smooth) for first in range(len(levels) - 2, -1, -1)]
    best: FarFit | None = None
    for first, scenes in chains:
        current = state
        for (fit, sensors), scene in list(zip(fits, scenes))[first:]:
            scene_at = scene.at(current)
            result = fit.run(scene_at, None, sensors.measurements(frames, scene_at)).result
            current = result.state
        scene_at = full_scenes[-1].at(current)
        last = fits[-1][1].measurements(frames, scene_at)
        overlap = float(np.mean([cast(SilhouetteMeasurement, m).overlap(scene_at) for m in last]))
        if best is None or overlap > best.overlap + _MIN_OVERLAP_GAIN:
            best = FarFit(result, overlap)
    assert best is not None
    return best
