"""Where a body may be when nothing tells from before: from markers, from keypoints of several cameras, from depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import KinefitError, TrackingError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.initialization.depth_score import limbs
from kinefit.initialization.depth_search import Search
from kinefit.initialization.from_depth import Start, start_from_points
from kinefit.initialization.from_points import pose_from_points
from kinefit.observations import DepthFrame, Frame, KeypointFrame, MarkerFrame, PointCloud
from kinefit.sensors.depth_view import camera_at

GAIN = 0.01  # of the score, a hundredth of the person's pixels, that another pose must explain more
LEAP = 0.05  # the same, for a limb that would be somewhere else: a forearm is about this much of a person
_AGREE = 30.0  # [px] between keypoints of several cameras that may be of one point


def find_starts(body: Body, rig: Rig, frames: Sequence[Frame], up: NDArray, count: int = 3) -> list[BodyState]:
    """States to begin with, the most trusted first; none where nothing of a person's size is seen.

    Six points or more of markers and keypoints of several cameras tell by themselves. Else one depth image or cloud is
    searched; where keypoints or markers show the same body, those states that they agree with come first.
    """
    points, x = _known_points(body, rig, frames)
    if len(points) >= 6:
        try:
            return [pose_from_points(body, points, x)[0]]
        except TrackingError:
            pass
    starts: list[Start] = []
    for frame in frames:
        view = _view(rig, frame)
        if view is not None and not starts:
            try:
                starts = start_from_points(body, *view, up=up, count=count)
            except KinefitError:
                continue
    if len(points):
        starts.sort(key=lambda start: float(np.median(np.linalg.norm(body.positions(start.state, points) - x, axis=1))))
    return [start.state for start in starts]


def find_limbs(search: Search, state: BodyState, seek: NDArray, tries: int = 200) -> list[tuple[BodyState, float]]:
    """States that a view speaks for more than for the given one, with the gain in score that each must show.

    Near ones come first: all else held, then the whole body moved. A limb that is found somewhere else altogether
    must explain `LEAP` more.

    Parameters
    ----------
    seek : (S,) bool, segments of which the whole limb is sought.
    tries : int, random poses of each limb
    """
    now, ends = search.score.of(state), search.ends(state)
    chosen = [limb for limb in search.limbs if seek[list(limb)].any()]
    own = np.flatnonzero(dofs_of_limbs(search.body, seek))
    near, value = search.polish(state, None, own, 6, 48, 1.5) if len(own) else (state, float(now))
    whole, better = search.polish(near, None, np.arange(search.body.tree.n_dofs), 8, 40, 0.6)
    out = [(near, value - now, GAIN), (whole, better - now, GAIN)]
    found = [(state, now)]
    for limb in chosen:
        found = search.limb(found[0][0], limb, None, ends, tries)
    out += [(s, v - now, LEAP) for s, v in found[:2]]
    return [(s, least) for s, gain, least in sorted(out, key=lambda o: o[2] - o[1]) if gain > least]


def dofs_of_limbs(body: Body, lost: NDArray) -> NDArray:
    """(6 + D,) bool: degrees of freedom of all limbs of which a segment is lost (S,)."""
    away = {s for limb in limbs(body) if lost[list(limb)].any() for s in limb}
    return np.concatenate([np.zeros(6, bool), np.isin(body.tree.owners, sorted(away))])


def _view(rig: Rig, frame: Frame) -> tuple[NDArray | None, Camera, NDArray | None] | None:
    """Points, camera and image to search."""
    if isinstance(frame, DepthFrame):
        return None, rig[frame.sensor], frame.depth
    if isinstance(frame, PointCloud) and frame.on_body and frame.segment is None and len(frame):
        return frame.points, camera_at(frame.points, frame.viewpoint), None
    return None


def _known_points(body: Body, rig: Rig, frames: Sequence[Frame]) -> tuple[PointSet, NDArray]:
    """Points of the body that are known in space: markers, and keypoints of several cameras."""
    names: list[str] = []
    segments: list[NDArray] = []
    places: list[NDArray] = []
    x: list[NDArray] = []
    seen: dict[str, dict[str, KeypointFrame]] = {}
    for frame in frames:
        if isinstance(frame, MarkerFrame):
            known = body.markers(frame.marker_set) if frame.marker_set else body.landmarks
            for name, position in zip(frame.names, frame.positions):
                if name in known.names and np.isfinite(position).all():
                    one = known.select((name,))
                    names.append(f"{frame.sensor}/{name}")
                    segments.append(one.segments[0])
                    places.append(one.points[0])
                    x.append(position)
        elif isinstance(frame, KeypointFrame):
            seen.setdefault(frame.keypoint_set, {})[frame.sensor] = frame
    for kind, views in seen.items():
        known = body.keypoints(kind) if kind else body.landmarks
        uv = np.full((len(known), len(rig), 2), np.nan)
        confidence = np.zeros(uv.shape[:2])
        for camera, frame in views.items():
            for name, pixel, trust in zip(frame.names, frame.uv, frame.confidence):
                if name in known.names:
                    at = known.names.index(name), rig.index(camera)
                    uv[at], confidence[at] = pixel, trust
        if len(views) > 1:
            found = triangulate_robust(rig, uv, confidence, max_residual_px=_AGREE)[0]
            for k in np.flatnonzero(np.isfinite(found).all(axis=1)):
                names.append(f"{kind}/{known.names[k]}")
                segments.append(known.segments[k])
                places.append(known.points[k])
                x.append(found[k])
    shape = (len(names), 3)
    points = PointSet(tuple(names), np.array(segments, np.int64), np.array(places, float).reshape(shape))
    return points, np.array(x, float).reshape(shape)
