"""Match grids without given seeds: seeds are found along lines of sight, in search boxes, or from SIFT features."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.images.photogrammetry.least_squares_matching import Grid, Matches, Seeds, as_points, grow
from kinefit.images.photogrammetry.matching.multi_image import search_box
from kinefit.images.photogrammetry.seeding import _kernels_rays as kernels
from kinefit.images.photogrammetry.spline_image import SplineImage

_POINTS_PER_ROUND = 200  # of a grid that are searched for seeds
_MAX_ROUNDS = 6
_MIN_ADDED_SHARE = 0.01  # of the grid that a round must add for another round
_MIN_SEEDS = 5  # of the first round, else SIFT features are used
_MAX_SEARCHED_POINTS = 40  # of a grid, in a later image
_SEARCH_REACH_PX = 30  # motion between images up to which no features are needed
_MIN_BOX_CORRELATION = 0.8  # of a match in a search box
_MAX_RUNNER_UP_RATIO = 0.85  # of the second-best correlation to the best
_MIN_FOUND_SHARE = 0.3  # of the points searched, else SIFT features are used


def grow_between(
    first: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], grid: Grid, *,
    window: int | ArrayLike, least: float,
) -> Matches:  # fmt: skip
    """Match a grid of one camera's image in the image of another camera at the same time.

    Seeds are searched along the lines of sight of some grid points, and again among those that region growing did not
    reach, so that separate surfaces get their own seeds. If there are too few, SIFT features give the seeds.

    Parameters
    ----------
    cameras : of the two images
    window : odd side [px], of all or of each grid point
    least : least correlation, 0 to 1, of a match
    """
    rng, out = np.random.default_rng(0), None
    textured = grid.inside & _has_texture(first, grid.points)
    for _ in range(_MAX_ROUNDS):
        unmatched = np.flatnonzero(textured if out is None else textured & ~out.found)
        seeds, _ = ray_seeds(first, second, cameras, grid.points[rng.permutation(unmatched)[:_POINTS_PER_ROUND]])
        if out is None and len(seeds.first) < _MIN_SEEDS:
            seeds = sift_seeds(first, second, cameras)
            return _reject_inconsistent(grid, grow(first, second, grid, seeds, window=window, least=least))
        left = grid if out is None else replace(grid, points=np.where(out.found[:, None], np.nan, grid.points))
        more = _reject_inconsistent(grid, grow(first, second, left, seeds, window=window, least=least))
        out = more if out is None else out.or_else(more)
        if more.found.sum() < _MIN_ADDED_SHARE * textured.sum():
            break
    assert out is not None
    return out


def grow_over_time(
    first: SplineImage, second: SplineImage, grid: Grid, *, window: int | ArrayLike, least: float
) -> Matches:
    """Match a grid of one image in a later one, with seeds from search boxes or, for large motions, SIFT features.

    Parameters
    ----------
    window : odd side [px], of all or of each grid point
    least : least correlation, 0 to 1, of a match

    Raises
    ------
    ObservationError
        The grid has no point.
    """
    points = grid.points[grid.inside]
    if not len(points):
        raise ObservationError("the surface is lost", remedy="Use more images between, or remove this one.")
    spots = points[np.random.default_rng(0).permutation(len(points))[:_MAX_SEARCHED_POINTS]]
    peaks = search_box(first, second, spots, reach=_SEARCH_REACH_PX, window=LINE_WINDOW)
    good = (peaks.best >= _MIN_BOX_CORRELATION) & (peaks.runner_up < _MAX_RUNNER_UP_RATIO * peaks.best)
    if good.sum() >= _MIN_FOUND_SHARE * len(spots):
        seeds = Seeds(spots[good], peaks.uv[good], np.tile(np.eye(2), (int(good.sum()), 1, 1)))
    else:
        seeds = sift_seeds(first, second)
        seeds = seeds if len(seeds.first) else Seeds.of(spots, spots)
    return _reject_inconsistent(grid, grow(first, second, grid, seeds, window=window, least=least))


def grow_through(
    first: SplineImage, middle: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], grid: Grid,
    own: Matches, *, window: int | ArrayLike, least: float,
) -> Matches:  # fmt: skip
    """Match a grid of an earlier image in another camera's later image, via the later image of the same camera.

    Parameters
    ----------
    first, middle : images of one camera, earlier and later
    second : of the other camera, at the time of `middle`
    cameras : of `middle` and `second`
    own : matches of the grid in `middle`
    window : odd side [px], of all or of each grid point
    least : least correlation, 0 to 1, of a match
    """
    spots = np.flatnonzero(own.found)
    spots = np.random.default_rng(0).permutation(spots)[:_MAX_SEARCHED_POINTS]
    seeds, index = ray_seeds(middle, second, cameras, own.uv[spots])
    if len(index) >= _MIN_FOUND_SHARE * len(spots):
        spots = spots[index]
        goal = seeds.second + np.einsum("nij,nj->ni", seeds.deformation, own.uv[spots] - seeds.first)
        seeds = Seeds(grid.points[spots], goal, seeds.deformation @ own.deformation[spots])
        return _reject_inconsistent(grid, grow(first, second, grid, seeds, window=window, least=least))
    return grow_over_time(first, second, grid, window=window, least=least)


def _has_texture(image: SplineImage, points: NDArray) -> NDArray[np.bool_]:
    """(N,) whether the grey values around points (N, 2) [px] vary by more than noise; False for NaN."""
    mean, square = (cv2.blur(values, (LINE_WINDOW, LINE_WINDOW)) for values in (image.grey, image.grey**2))
    at = np.nan_to_num(np.rint(points)).astype(int)
    scatter = (square - mean**2)[at[:, 1], at[:, 0]]
    return np.isfinite(points).all(axis=1) & (scatter > (MIN_TEXTURE_SIGMAS * image.noise) ** 2)


def _reject_inconsistent(grid: Grid, found: Matches) -> Matches:
    """Reject matches (from wrong seeds) that disagree with most neighbours' maps or have no neighbours."""
    points, uv, maps = (v.reshape(-1, grid.columns, *v.shape[1:]) for v in (grid.points, found.uv, found.deformation))
    neighbours, consistent = np.zeros(points.shape[:2]), np.zeros(points.shape[:2])
    upper, lower, all_ = slice(1, None), slice(None, -1), slice(None)
    for cells, adjacent in (
        ((upper, all_), (lower, all_)), ((lower, all_), (upper, all_)),
        ((all_, upper), (all_, lower)), ((all_, lower), (all_, upper)),
    ):  # fmt: skip
        predicted = uv[adjacent] + np.einsum("ijkl,ijl->ijk", maps[adjacent], points[cells] - points[adjacent])
        off = np.linalg.norm(uv[cells] - predicted, axis=2)
        neighbours[cells] += np.isfinite(off)
        consistent[cells] += off <= grid.step / 2
    return found.only((2 * consistent >= np.maximum(neighbours, 1)).ravel())


_MAX_SIFT_IMAGE_PX = 1200  # larger images are reduced: features are larger than grains
_MAX_DESCRIPTOR_RATIO = 0.8  # of the best to the second-best descriptor distance (Lowe)
_MAX_SIFT_SEEDS = 200
_MAX_RAY_DISTANCE_PX = 2.0  # of a feature from the line of sight in the reduced image: three sigma


def sift_seeds(
    first: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera] | None = None
) -> Seeds:
    """Match SIFT features of two images, best descriptor ratio first; rotation and scale give the deformation.

    Parameters
    ----------
    cameras : of the two images, if calibrated: features whose rays miss each other are rejected

    Returns
    -------
    Seeds
        Empty if the images have nothing in common or their texture repeats.
    """
    (points1, turns1, found1), (points2, turns2, found2) = map(_sift_features, (first, second))
    no_seeds = Seeds(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    if found1 is None or found2 is None or min(len(found1), len(found2)) < 2:
        return no_seeds
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(found1, found2, k=2)
    pairs_by_ratio = sorted(
        (a.distance / max(b.distance, 1e-9), a.queryIdx, a.trainIdx) for a, b in (p for p in pairs if len(p) == 2)
    )
    pairs_by_ratio = [pair for pair in pairs_by_ratio if pair[0] < _MAX_DESCRIPTOR_RATIO]
    if not pairs_by_ratio:
        return no_seeds
    i, j = (np.array([pair[k] for pair in pairs_by_ratio]) for k in (1, 2))
    one, two = points1[i], points2[j]
    deformation = turns2[j] @ np.linalg.inv(turns1[i])
    keep = np.arange(len(one))
    if cameras is not None:
        scale = max(max(first.size), max(second.size)) / _MAX_SIFT_IMAGE_PX
        uv = np.stack([one, two], axis=1)
        _, is_inlier, _ = triangulate_robust(Rig(cameras), uv, max_residual_px=_MAX_RAY_DISTANCE_PX * max(scale, 1.0))
        keep = np.flatnonzero(is_inlier.all(axis=1))
    keep = keep[:_MAX_SIFT_SEEDS]
    return Seeds(one[keep], two[keep], deformation[keep])


def _sift_features(image: SplineImage) -> tuple[NDArray, NDArray, NDArray | None]:
    """Positions (K, 2) [px], rotation times scale (K, 2, 2), and descriptors of SIFT features."""
    scale = min(1.0, _MAX_SIFT_IMAGE_PX / max(image.size))
    pixels = cv2.resize(image.grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image.grey
    low, high = np.percentile(pixels, (1, 99))
    pixels = np.clip((pixels - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    sift = cv2.SIFT_create(3000)  # type: ignore[attr-defined]
    keys, descriptors = sift.detectAndCompute(pixels, None)
    points = np.array([key.pt for key in keys]).reshape(-1, 2)
    angle, size = np.deg2rad([key.angle for key in keys]), np.array([key.size for key in keys])
    cos, sin = size * np.cos(angle), size * np.sin(angle)
    turns = np.stack([cos, -sin, sin, cos], axis=-1).reshape(-1, 2, 2)
    return (points + 0.5) / scale - 0.5, turns, descriptors


LINE_WINDOW = 17  # [px] narrower windows repeat somewhere on a line of a thousand pixels
_LINE_CORNERS = 48  # evenly spaced in 1 / distance
_MIN_DISTANCE_RATIO = 0.5  # distance of a point over that between the cameras
_MAX_DISTANCE_RATIO = 200.0
_MIN_LINE_CORRELATION = 0.6  # low because of nearest-pixel sampling and inclined surfaces
MIN_TEXTURE_SIGMAS = 3.0  # standard deviation of a window's grey values over that of the noise
_MAX_RAY_ERROR = 1e-3  # [rad] between a point and the ray of its image: larger where a lens model folds back


def ray_seeds(
    first: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], points: ArrayLike
) -> tuple[Seeds, NDArray[np.int64]]:
    """Find points of the first image along their lines of sight in the second; ambiguous ones are rejected.

    The surface is assumed to face the middle of both cameras, which gives the window's deformation at every distance.

    Parameters
    ----------
    cameras : of the two images
    points : (S, 2) [px] in the first image, rounded to the nearest pixel

    Returns
    -------
    Seeds
        The K points that were found.
    index : (K,) int, their indices in `points`
    """
    at = np.rint(as_points(points))
    lines, maps = _lines_of_sight(cameras, at)
    uv, found = np.empty_like(at), np.empty((len(at), 4))
    best, runner_up = np.empty(len(at)), np.empty(len(at))
    least = (MIN_TEXTURE_SIGMAS * first.noise) ** 2
    kernels.search_lines(first.grey, second.grey, at, lines, maps, LINE_WINDOW // 2, least, uv, found, best, runner_up)
    good = np.flatnonzero((best >= _MIN_LINE_CORRELATION) & (runner_up < _MAX_RUNNER_UP_RATIO * best))
    return Seeds(at[good], uv[good], found[good].reshape(-1, 2, 2)), good


def _lines_of_sight(cameras: tuple[Camera, Camera], at: NDArray) -> tuple[NDArray, NDArray]:
    """Images (S, K, 2) [px] in the second camera of points on the first one's rays, and maps (S, K, 4) of windows."""
    one, two = cameras
    base = float(np.linalg.norm(one.centre_world - two.centre_world))
    distance = base / np.linspace(1.0 / _MIN_DISTANCE_RATIO, 1.0 / _MAX_DISTANCE_RATIO, _LINE_CORNERS)
    ray = one.ray(at)
    ray_steps = [one.ray(at + step) - ray for step in np.eye(2)]
    x = one.centre_world + distance[:, None] * ray[:, None]
    uv, J = two.project_with_jacobian(x)
    ray_back = x - two.centre_world
    ray_back /= np.linalg.norm(ray_back, axis=2, keepdims=True)
    normal = ray[:, None] + ray_back
    inclined = np.einsum("ski,si->sk", normal, ray)
    out = np.empty((*uv.shape, 2))
    for k, step in enumerate(ray_steps):
        tangent = step[:, None] - ray[:, None] * (np.einsum("ski,si->sk", normal, step) / inclined)[..., None]
        out[..., k] = np.einsum("skij,skj->ski", J, distance[:, None] * tangent)
    inside = ((uv > 0) & (uv < np.array(two.size))).all(axis=2, keepdims=True)
    uv = np.where(inside, uv, np.nan)
    ray_errors = np.linalg.norm(two.ray(uv) - ray_back, axis=2, keepdims=True)
    uv = np.where(ray_errors < _MAX_RAY_ERROR, uv, np.nan)
    return np.ascontiguousarray(uv), np.ascontiguousarray(out.reshape(*uv.shape[:2], 4))
