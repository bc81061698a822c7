"""A start with no pose given, from one depth image: where is the trunk, who is which limb, how is it bent.

Geodesic ends of the person's surface (Plagemann et al., ICRA 2010; Baak et al., ICCV 2011) propose where hands and
feet are, random poses within the joints' ranges propose the rest. What decides is one score, both ways: how much of
the person is explained by the body drawn there, less what is drawn where the sensor saw past it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import BodyError, ObservationError, TrackingError
from kinefit.geometry.camera import Camera
from kinefit.images.depth import to_points
from kinefit.images.depth_noise import denoised, noise_of, without_speckles
from kinefit.images.depth_scene import DepthBlob, find_floor, foreground, people
from kinefit.initialization.depth_search import PostureSearch
from kinefit.sensors.surfaces.depth_view import DepthView, splat, view_of
from kinefit.subject.depth import fit_surfaces
from kinefit.subject.subject import SubjectFit

_GAPS = (0.15, 0.075)  # [m] as `people` takes it: forearms towards the sensor are torn off by holes of 0.2 m; and half
# of it, for those who stand by a table or a wall: people are then still closed, a pixel is some centimetres wide
_SAME = 0.65  # overlap of two outlines of one person: an upper body without both arms keeps 0.7 (rule of nines)
_FLAT = 0.015  # [m] deviation from a plane, of a wall; a person who faces the sensor, arms down, has 0.02 or more
_GOOD = 0.7  # score of a pose that needs no second attempt: right ones of rendered bodies have 0.73 to 0.9
_FAIR = 0.55  # score of a pose from which a size may be found, by a body of another size
_MOST = 3  # largest things in view that are tried
_FEWEST = 60  # measured points; a person 7.5 m from a camera of 160 x 124 pixels has several hundred


@dataclass(frozen=True, eq=False)
class Start:
    """A pose found with none given.

    Parameters
    ----------
    state : BodyState
    score : float, 1 at best
        Share of the person that the body explains, less what contradicts it. 0.5 is common for a body of another
        person's size, 0.8 for the right one.
    visible : (S,) in 0..1
        Share of each segment that the sensor could see. One that is 0 (beside the image, behind another part) is
        held by the prior posture alone.
    """

    state: BodyState
    score: float
    visible: NDArray


def start_from_points(
    body: Body,
    points: ArrayLike | None,
    camera: Camera,
    depth: NDArray | None = None,
    *,
    background: NDArray | None = None,
    up: ArrayLike = (0.0, 1.0, 0.0),
    count: int = 5,
    attempts: int = 2,
    seed: int = 0,
    forward: ArrayLike | None = None,
) -> list[Start]:
    """Poses of a body in one depth image or cloud, the best first.

    Parameters
    ----------
    body : Body with surfaces; of about the person's size (see `fit_surfaces`).
    points : (N, 3) [m] in the world, or None
        Points on the person and nothing else. None: the person is sought in `depth`, and where several are in view
        the one that the body explains best is taken.
    camera : Camera of the sensor
    depth : (H, W) [m], optional
        Its image, 0 where nothing was measured. It shows what is empty.
    background : (H, W) [m], optional
        What it sees of the empty scene, 0 where that is not known: the person is sought in what is new.
    up : (3,) upwards, in the world
    count : int, poses at most
    attempts : int
        How often all is tried at most, until a good pose is found: about 1.1 s of one core each.
    seed : int of the random tries; the same gives the same poses.
    forward : (3,) where the root faced a moment ago, optional; a person seldom turns about in a second.

    Raises
    ------
    ObservationError
        No points, an image of another size, or neither points nor an image.
    TrackingError
        Nothing in view is of a person's size.
    BodyError
        The body has no surfaces.
    """
    *_, found = starts_by_attempt(
        body, points, camera, depth, background=background, up=up, count=count, attempts=attempts, seed=seed,
        forward=forward,
    )  # fmt: skip
    return found


def starts_by_attempt(
    body: Body, points: ArrayLike | None, camera: Camera, depth: NDArray | None = None, *,
    background: NDArray | None = None, up: ArrayLike = (0.0, 1.0, 0.0), count: int = 5, attempts: int = 2,
    seed: int = 0, forward: ArrayLike | None = None,
) -> Iterator[list[Start]]:  # fmt: skip
    """The best poses after each attempt, until one is good; arguments as of `start_from_points`."""
    found: list[tuple[PostureSearch, BodyState]] = []
    views: list[DepthView] = []
    more = _views(body, points, camera, depth, up, background)
    for attempt in range(max(attempts, 1)):
        views += next(more, [])
        searches = _searches(body, views, up, seed + attempt, forward)
        found += [(search, state) for search in searches for state in search.best(count)]
        found.sort(key=lambda f: -_meant(*f))
        yield [Start(state, search.value(state), search.score.visible(state)) for search, state in found[:count]]
        if _meant(*found[0]) > _GOOD:
            return


def _meant(search: PostureSearch, state: BodyState) -> float:
    """Score of a person among several: one of whom little is seen (less than head and shoulders) counts for less."""
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
    """The person's own size, and a pose in each of a few depth images: poses, sizes, better poses, better sizes.

    With a body of another size limbs lie on the trunk's border; once the trunk is as wide as the person's they are
    free to be found.

    Parameters
    ----------
    depths : K x (H, W) [m]; three to five, the more different the postures the better.
    camera, background, up, seed : see `start_from_points`
    rounds : int

    Raises
    ------
    ObservationError, TrackingError, BodyError
        As `start_from_points` and `fit_surfaces`.
    """
    found: list[tuple[DepthView, BodyState]] = []
    scores: list[float] = []
    for depth in depths:
        tried: list[tuple[PostureSearch, BodyState]] = []
        for views in _views(body, None, camera, depth, up, background):
            tried += [(s, s.best(1)[0]) for s in _searches(body, views, up, seed)]
            if max(_meant(*t) for t in tried) > _FAIR:
                break
        search, state = max(tried, key=lambda t: _meant(*t))
        found.append((search.view, state))
        scores.append(search.value(state))
    used = [k for k, score in enumerate(scores) if score > min(_FAIR, max(scores) - 1e-9)]  # wrong poses tell no size
    views = [view for view, _ in found]
    states = [state for _, state in found]
    mean: NDArray | None = None
    for _ in range(rounds):
        some = [views[k] for k in used]
        fit = fit_surfaces(body, [v.cloud for v in some], [states[k] for k in used], views=some, start=mean)
        for k, state in zip(used, fit.states):
            states[k] = state
        mean, searches = fit.mean, [PostureSearch(fit.body, v, _unit(up), np.random.default_rng(seed)) for v in views]
        states = [s.refined(state, s.ends(state), 1) for s, state in zip(searches, states)]
    starts = [Start(state, s.value(state), s.score.visible(state)) for s, state in zip(searches, states)]
    return fit, starts


def _unit(up: ArrayLike) -> NDArray:
    vector = np.asarray(up, float)
    if vector.shape != (3,) or not np.isfinite(vector).all() or np.linalg.norm(vector) < 1e-9:
        raise ObservationError(f"up is no direction: {vector}", remedy="Give three numbers, such as (0, 1, 0).")
    return vector / np.linalg.norm(vector)


def _searches(
    body: Body, views: Sequence[DepthView], up: ArrayLike, seed: int, forward: ArrayLike | None = None
) -> list[PostureSearch]:
    ahead = None if forward is None else np.asarray(forward, float)
    return [PostureSearch(body, view, _unit(up), np.random.default_rng(seed), ahead) for view in views]


def _views(
    body: Body, points: ArrayLike | None, camera: Camera, depth: NDArray | None, up: ArrayLike,
    background: NDArray | None,
) -> Iterator[list[DepthView]]:  # fmt: skip
    """Views of the persons that may be meant; then of parts of them, where those may be a person by a table."""
    direction = _unit(up)
    if not body.surfaces:
        raise BodyError(f"body '{body.name}' has no surfaces", remedy="Depth needs some; see the catalogue's bodies.")
    if depth is not None:
        depth = np.asarray(depth, float)
        if depth.shape != (camera.size[1], camera.size[0]):
            problem = f"a depth image of shape {depth.shape}, camera {camera.name} has {camera.size}"
            raise ObservationError(problem, remedy="Give the camera of this image, or camera.scaled(size).")
        depth = without_speckles(np.where((depth > 0) & (depth < np.inf), depth, 0.0), camera, closed=True)
    if points is None:
        if depth is None:
            raise ObservationError("neither points nor a depth image", remedy="Give one of them.")
        smooth, none = denoised(depth, camera), True
        new = None if background is None else foreground(smooth, background)
        for blobs in _blobs(smooth, camera, direction, new):
            yield [view_of(smooth, blob.mask, camera) for blob in blobs]
            none = False
        if none:
            raise TrackingError(
                "nothing in the depth image is of a person's size", remedy=_scale_remedy(depth[depth > 0], body)
            )
        return
    cloud = np.asarray(points, float).reshape(-1, 3)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    coarse, small = splat(cloud, camera)
    if np.sum(coarse > 0) < min(_FEWEST, len(cloud)) or len(cloud) < _FEWEST:
        remedy = "Check the unit (metres), the camera's pose and the range gate."
        raise ObservationError(f"only {len(cloud)} points, {np.sum(coarse > 0)} in the camera's image", remedy=remedy)
    if np.ptp(cloud, axis=0).max() > 3.0 * max(body.stature, 1.0):
        raise ObservationError(
            f"the points reach over {np.ptp(cloud, axis=0).max():.3g} m, the body is {body.stature:.2f} m tall",
            remedy="Give the person's points only, in metres (are these millimetres?).",
        )
    if depth is None:
        yield [view_of(coarse, coarse > 0, small)]
        return
    near, sigma = _resized(coarse, depth.shape), noise_of(depth)
    person = (depth > 0) & (np.abs(depth - near) < 0.05 + 3.0 * sigma)
    smooth = denoised(depth, camera, sigma)
    yield [view_of(smooth, person, camera)]


def _blobs(depth: NDArray, camera: Camera, up: NDArray, mask: NDArray | None) -> Iterator[list[DepthBlob]]:
    """Things of a person's size, the likeliest first; then those that are only things if less is joined to them."""
    floor = find_floor(to_points(depth, camera, step=max(camera.size[0] // 160, 1)), up)
    known: list[DepthBlob] = []
    for gap in _GAPS:
        new = [b for b in people(depth, camera, mask=mask, floor=floor, gap=gap) if not any(_same(b, k) for k in known)]
        new.sort(key=lambda b: _flat(to_points(depth, camera, mask=b.mask)))
        known += new
        if new:
            yield new[:_MOST]


def _same(a: DepthBlob, b: DepthBlob) -> bool:
    return bool(np.sum(a.mask & b.mask) > _SAME * np.sum(a.mask | b.mask))


def _flat(x: NDArray) -> bool:
    """Whether points (N, 3) [m] lie in a plane, as of a wall."""
    return bool(np.linalg.eigvalsh(np.cov(x.T))[0] < _FLAT**2)


def _resized(coarse: NDArray, shape: tuple[int, ...]) -> NDArray:
    rows, columns = (np.arange(n) * m // n for n, m in zip(shape, coarse.shape))
    return coarse[np.ix_(rows, columns)]


def _scale_remedy(values: NDArray, body: Body) -> str:
    if not len(values):
        return "The image holds no measurement: check the range gate and the unit."
    middle = float(np.median(values))
    if middle > 100.0:
        return f"Its median is {middle:.4g}: millimetres taken for metres? Set the unit."
    if middle < 0.05:
        return f"Its median is {middle:.2g} m: is the unit right?"
    return "Check the camera's focal length, the unit and the range gate."
