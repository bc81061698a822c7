"""Find an initial pose in one depth image, without a former pose.

Geodesic ends of the person's surface (Plagemann et al., ICRA 2010; Baak et al., ICCV 2011) propose positions of hands
and feet. Random poses within the joints' ranges propose the rest. Poses are compared by one score: the share of the
person that the rendered body explains, minus rendered pixels where the sensor saw farther.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import BodyError, ObservationError, TrackingError
from kinefit.fitting.initialization.depth_search import PostureSearch
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.fitting.subject.surfaces import fit_surfaces
from kinefit.geometry.camera import Camera
from kinefit.images.depth import denoised, noise_of, to_points, without_speckles
from kinefit.images.depth_scene import DepthBlob, find_floor, foreground, people
from kinefit.sensors.surfaces.depth_view import DepthView, splat, view_of

_JOINING_GAPS = (0.15, 0.075)  # [m] for `people`: forearms towards the sensor are separated by holes of 0.2 m. Half of
# it for people next to a table or a wall: a person is still connected, as a pixel is some centimetres wide
_MIN_SAME_OVERLAP = 0.65  # of two masks of one person: an upper body without both arms keeps 0.7 (rule of nines)
_MAX_WALL_DEVIATION = 0.015  # [m] from a plane; a person who faces the sensor, arms down, has 0.02 or more
_MIN_GOOD_SCORE = 0.7  # needs no second attempt: right poses of rendered bodies have 0.73 to 0.9
_MIN_SIZE_SCORE = 0.55  # of a pose for sizing, by a body of another size ...
_SIZE_SCORE_MARGIN = 0.15  # ... or within this of the best: a body far off in size explains every image poorly
_MAX_BLOBS = 3  # largest objects in view that are tried
_MIN_POINTS = 60  # a person 7.5 m from a camera of 160 x 124 pixels has several hundred


@dataclass(frozen=True, eq=False)
class Start:
    """A pose found without a former pose.

    Parameters
    ----------
    state : of the body
    score : at most 1
        Share of the person that the body explains, minus what contradicts it. 0.5 is common for a body of another size,
        0.8 for one of the right size.
    visible : (S,) in 0..1
        Share of each segment that the sensor could see. At 0 (outside of the image, or occluded) the prior posture
        alone determines it.
    """

    state: BodyState
    score: float
    visible: NDArray


@dataclass(frozen=True, eq=False)
class StartSearch:
    """How poses are searched.

    Parameters
    ----------
    count : most poses that are returned
    attempts : int
        Most attempts until a good pose is found: about 1.1 s of one core each.
    seed : of the random search; the same seed gives the same poses
    forward : (3,) heading of the root a moment ago; people rarely turn around within a second. Default: unknown
    """

    count: int = 5
    attempts: int = 2
    seed: int = 0
    forward: ArrayLike | None = None


DEFAULT_SEARCH = StartSearch()


def start_from_points(
    body: Body,
    points: ArrayLike | None,
    camera: Camera,
    depth: NDArray | None = None,
    *,
    background: NDArray | None = None,
    up: ArrayLike = (0.0, 1.0, 0.0),
    search: StartSearch = DEFAULT_SEARCH,
) -> list[Start]:
    """Find poses of a body in one depth image or point cloud, the best first.

    Parameters
    ----------
    body : Body with surfaces, of about the person's size (see `fit_surfaces`)
    points : (N, 3) [m] in the world, or None
        Points on the person only. None: the person is searched in `depth`; of several, the one that the body explains
        best.
    camera : Camera of the sensor
    depth : (H, W) [m], optional
        Its depth image, 0 where nothing was measured; it shows empty space.
    background : (H, W) [m], optional
        Depth of the empty scene, 0 where unknown: the person is searched in the foreground only.
    up : (3,) upwards, in the world
    search : number of poses and attempts, seed, heading

    Raises
    ------
    ObservationError
        There are no points, the image has another size, or there is neither.
    TrackingError
        Nothing in view has a person's size.
    BodyError
        The body has no surfaces.
    """
    *_, found = starts_by_attempt(body, points, camera, depth, background=background, up=up, search=search)
    return found


def starts_by_attempt(
    body: Body, points: ArrayLike | None, camera: Camera, depth: NDArray | None = None, *,
    background: NDArray | None = None, up: ArrayLike = (0.0, 1.0, 0.0), search: StartSearch = DEFAULT_SEARCH,
) -> Iterator[list[Start]]:  # fmt: skip
    """Yield the best poses after each attempt, until one is good; parameters and errors as in `start_from_points`."""
    found: list[tuple[PostureSearch, BodyState]] = []
    views: list[DepthView] = []
    view_batches = _views(body, points, camera, depth, up, background)
    for attempt in range(max(search.attempts, 1)):
        views += next(view_batches, [])
        postures = _searches(body, views, up, search.seed + attempt, search.forward)
        found += [(posture, state) for posture in postures for state in posture.best(search.count)]
        found.sort(key=lambda f: -_person_score(*f))
        best = found[: search.count]
        yield [Start(state, posture.value(state), posture.score.visible(state)) for posture, state in best]
        if _person_score(*found[0]) > _MIN_GOOD_SCORE:
            return


def _person_score(search: PostureSearch, state: BodyState) -> float:
    """Score for choosing among several people: lower if less than head and shoulders is visible."""
    area = float(np.sum((search.view.observed / search.view.lens[0]) ** 2))
    return search.value(state) * min(area / (0.1 * max(search.body.stature, 0.1) ** 2), 1.0)


def sized_start(
    body: Body,
    depths: Sequence[NDArray],
    camera: Camera,
    *,
    background: NDArray | None = None,
    up: ArrayLike = (0.0, 1.0, 0.0),
    rounds: int = 2,
    seed: int = 0,
) -> tuple[SubjectFit, list[Start]]:
    """Fit a person's size, and a pose in each of a few depth images, by alternating poses and sizes.

    With a body of another size, limbs seem to lie on the trunk's border until the trunk has the right width.

    Parameters
    ----------
    depths : K images (H, W) [m], three to five with different postures
    camera, background, up, seed : see `start_from_points`
    rounds : number of alternations

    Raises
    ------
    ObservationError, TrackingError, BodyError
        As `start_from_points` and `fit_surfaces`.
    """
    found: list[tuple[DepthView, BodyState]] = []
    scores: list[float] = []
    for depth in depths:
        candidates: list[tuple[PostureSearch, BodyState]] = []
        for views in _views(body, None, camera, depth, up, background):
            candidates += [(s, s.best(1)[0]) for s in _searches(body, views, up, seed)]
            if max(_person_score(*t) for t in candidates) > _MIN_SIZE_SCORE:
                break
        search, state = max(candidates, key=lambda t: _person_score(*t))
        found.append((search.view, state))
        scores.append(search.value(state))
    used = [k for k, score in enumerate(scores) if score > min(_MIN_SIZE_SCORE, max(scores) - _SIZE_SCORE_MARGIN)]
    views = [view for view, _ in found]
    states = [state for _, state in found]
    mean: NDArray | None = None
    for _ in range(rounds):
        used_views = [views[k] for k in used]
        fit = fit_surfaces(body, [v.cloud for v in used_views], [states[k] for k in used], views=used_views, start=mean)
        for k, state in zip(used, fit.states):
            states[k] = state
        mean, searches = fit.mean, [PostureSearch(fit.body, v, _unit(up), np.random.default_rng(seed)) for v in views]
        states = [s.refined(state, s.ends(state), 1) for s, state in zip(searches, states)]
    starts = [Start(state, s.value(state), s.score.visible(state)) for s, state in zip(searches, states)]
    return fit, starts


def _unit(up: ArrayLike) -> NDArray:
    vector = np.asarray(up, float)
    if vector.shape != (3,) or not np.isfinite(vector).all() or np.linalg.norm(vector) < 1e-9:
        raise ObservationError(f"up is not a direction: {vector}", remedy="Give three numbers, such as (0, 1, 0).")
    return vector / np.linalg.norm(vector)


def _searches(
    body: Body, views: Sequence[DepthView], up: ArrayLike, seed: int, forward: ArrayLike | None = None
) -> list[PostureSearch]:
    heading = None if forward is None else np.asarray(forward, float)
    return [PostureSearch(body, view, _unit(up), np.random.default_rng(seed), heading) for view in views]


def _views(
    body: Body, points: ArrayLike | None, camera: Camera, depth: NDArray | None, up: ArrayLike,
    background: NDArray | None,
) -> Iterator[list[DepthView]]:  # fmt: skip
    """Yield views of the candidate people; then of parts of them, for a person next to a table."""
    direction = _unit(up)
    if not body.surfaces:
        raise BodyError(f"body '{body.name}' has no surfaces", remedy="Use a body of the catalogue, or add surfaces.")
    if depth is not None:
        depth = np.asarray(depth, float)
        if depth.shape != (camera.size[1], camera.size[0]):
            problem = f"a depth image of shape {depth.shape}, camera {camera.name} has {camera.size}"
            raise ObservationError(problem, remedy="Give the camera of this image, or camera.scaled(size).")
        depth = without_speckles(np.where((depth > 0) & (depth < np.inf), depth, 0.0), camera, closed=True)
    if points is None:
        if depth is None:
            raise ObservationError("neither points nor a depth image", remedy="Give one of them.")
        smooth, is_empty = denoised(depth, camera), True
        new_mask = None if background is None else foreground(smooth, background)
        for blobs in _blobs(smooth, camera, direction, new_mask):
            yield [view_of(smooth, blob.mask, camera) for blob in blobs]
            is_empty = False
        if is_empty:
            raise TrackingError(
                "nothing in the depth image has the size of a person", remedy=_scale_remedy(depth[depth > 0])
            )
        return
    cloud = np.asarray(points, float).reshape(-1, 3)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    coarse, small = splat(cloud, camera)
    if np.sum(coarse > 0) < min(_MIN_POINTS, len(cloud)) or len(cloud) < _MIN_POINTS:
        remedy = "Check the unit (metres), the camera's pose and the range gate."
        raise ObservationError(f"only {len(cloud)} points, {np.sum(coarse > 0)} in the camera's image", remedy=remedy)
    if np.ptp(cloud, axis=0).max() > 3.0 * max(body.stature, 1.0):
        raise ObservationError(
            f"the points reach over {np.ptp(cloud, axis=0).max():.3g} m, the body is {body.stature:.2f} m tall",
            remedy="Give the person's points only, in metres (these may be millimetres).",
        )
    if depth is None:
        yield [view_of(coarse, coarse > 0, small)]
        return
    near, sigma = _resized(coarse, depth.shape), noise_of(depth)
    person = (depth > 0) & (np.abs(depth - near) < 0.05 + 3.0 * sigma)
    smooth = denoised(depth, camera, sigma)
    yield [view_of(smooth, person, camera)]


def _blobs(depth: NDArray, camera: Camera, up: NDArray, mask: NDArray | None) -> Iterator[list[DepthBlob]]:
    """Yield objects of a person's size, the most likely first; then those found with a smaller joining gap."""
    floor = find_floor(to_points(depth, camera, step=max(camera.size[0] // 160, 1)), up)
    known: list[DepthBlob] = []
    for gap in _JOINING_GAPS:
        blobs = people(depth, camera, mask=mask, floor=floor, gap=gap)
        new = [
            blob for blob in blobs
            if not any(np.sum(blob.mask & k.mask) > _MIN_SAME_OVERLAP * np.sum(blob.mask | k.mask) for k in known)
        ]  # fmt: skip
        new.sort(key=lambda b: _is_flat(to_points(depth, camera, mask=b.mask)))
        known += new
        if new:
            yield new[:_MAX_BLOBS]


def _is_flat(x: NDArray) -> bool:
    """Whether points (N, 3) [m] lie in a plane, like a wall."""
    return bool(np.linalg.eigvalsh(np.cov(x.T))[0] < _MAX_WALL_DEVIATION**2)


def _resized(coarse: NDArray, shape: tuple[int, ...]) -> NDArray:
    rows, columns = (np.arange(n) * m // n for n, m in zip(shape, coarse.shape))
    return coarse[np.ix_(rows, columns)]


def _scale_remedy(values: NDArray) -> str:
    if not len(values):
        return "The image holds no measurement: check the range gate and the unit."
    middle = float(np.median(values))
    if middle > 100.0:
        return f"Its median is {middle:.4g}: probably millimetres. Set the unit."
    if middle < 0.05:
        return f"Its median is {middle:.2g} m: check the unit."
    return "Check the camera's focal length, the unit and the range gate."
