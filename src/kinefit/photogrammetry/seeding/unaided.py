"""Grids matched without seeds: these are found along lines of sight, in boxes, or from features."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.photogrammetry.least_squares_matching import Matches, places
from kinefit.photogrammetry.matching.correlation import search_box
from kinefit.photogrammetry.region_growing import Grid, Seeds, grow
from kinefit.photogrammetry.seeding import _kernels_rays as kernels
from kinefit.photogrammetry.spline_image import SplineImage

_PLACES = 200  # of a grid, at which seeds are sought in a round
_ROUNDS = 6
_SHARE = 0.01  # of the grid that a round adds if there is to be another
_FEWEST = 5  # seeds of the first round, below which features are asked instead
_MOVED = 40  # places that are sought in a later image
_REACH = 30  # [px] by which a surface moves between images that need no features
_ALIKE, _UNIQUE = 0.8, 0.85  # least correlation there; the runner-up's share of it
_FOUND = 0.3  # of the places sought, below which features are asked instead


def grow_between(
    first: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], grid: Grid, *,
    window: int | ArrayLike, least: float,
) -> Matches:  # fmt: skip
    """Match a grid of one camera's image in another's of the same time.

    Places of the grid are sought along their lines of sight; then some of those to which nothing grew, so that surfaces
    apart from each other get seeds of their own. SIFT features are asked where lines of sight tell too little.
    """
    rng, out = np.random.default_rng(0), None
    textured = grid.inside & _textured(first, grid.points)
    for _ in range(_ROUNDS):
        left = np.flatnonzero(textured if out is None else textured & ~out.found)
        seeds, _ = ray_seeds(first, second, cameras, grid.points[rng.permutation(left)[:_PLACES]])
        if out is None and len(seeds.first) < _FEWEST:
            seeds = sift_seeds(first, second, cameras)
            return _agreeing(grid, grow(first, second, grid, seeds, window=window, least=least))
        more = _agreeing(grid, grow(first, second, _without(grid, out), seeds, window=window, least=least))
        out = more if out is None else out.or_else(more)
        if more.found.sum() < _SHARE * textured.sum():
            break
    assert out is not None
    return out


def grow_over_time(
    first: SplineImage, second: SplineImage, grid: Grid, *, window: int | ArrayLike, least: float
) -> Matches:
    """Match a grid of one image in a later one: from near where it was, or from features if it went far.

    Raises
    ------
    ObservationError
        A grid without places.
    """
    places = grid.points[grid.inside]
    if not len(places):
        raise ObservationError("the surface is lost", remedy="Take more images between, or leave this one out.")
    spots = places[np.random.default_rng(0).permutation(len(places))[:_MOVED]]
    told = search_box(first, second, spots, reach=_REACH, window=WINDOW)
    good = (told.best >= _ALIKE) & (told.runner_up < _UNIQUE * told.best)
    if good.sum() >= _FOUND * len(spots):
        seeds = Seeds(spots[good], told.uv[good], np.tile(np.eye(2), (int(good.sum()), 1, 1)))
    else:
        seeds = sift_seeds(first, second)
        seeds = seeds if len(seeds.first) else Seeds.of(spots, spots)
    return _agreeing(grid, grow(first, second, grid, seeds, window=window, least=least))


def grow_through(
    first: SplineImage, middle: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], grid: Grid,
    own: Matches, *, window: int | ArrayLike, least: float,
) -> Matches:  # fmt: skip
    """Match a grid of an earlier image in another camera's later one, by way of the own camera's later image.

    Parameters
    ----------
    first, middle : images of one camera, earlier and later
    second : of the other camera, at the time of `middle`
    cameras : of `middle` and `second`
    own : the grid in `middle`
    """
    spots = np.flatnonzero(own.found)
    spots = np.random.default_rng(0).permutation(spots)[:_MOVED]
    seeds, index = ray_seeds(middle, second, cameras, own.uv[spots])
    if len(index) >= _FOUND * len(spots):
        spots = spots[index]
        goal = seeds.second + np.einsum("nij,nj->ni", seeds.deformation, own.uv[spots] - seeds.first)
        seeds = Seeds(grid.points[spots], goal, seeds.deformation @ own.deformation[spots])
        return _agreeing(grid, grow(first, second, grid, seeds, window=window, least=least))
    return grow_over_time(first, second, grid, window=window, least=least)


def _textured(image: SplineImage, points: NDArray) -> NDArray[np.bool_]:
    """(N,) whether the grey values about points (N, 2) [px] scatter by more than noise; False of NaN."""
    mean, square = (cv2.blur(values, (WINDOW, WINDOW)) for values in (image.grey, image.grey**2))
    at = np.nan_to_num(np.rint(points)).astype(int)
    scatter = (square - mean**2)[at[:, 1], at[:, 0]]
    return np.isfinite(points).all(axis=1) & (scatter > (TEXTURE * image.noise) ** 2)


def _agreeing(grid: Grid, found: Matches) -> Matches:
    """Without points that are not where most of their neighbours' maps put them, or have no neighbours: wrong seeds."""
    points, uv, maps = (v.reshape(-1, grid.columns, *v.shape[1:]) for v in (grid.points, found.uv, found.deformation))
    there, agree = np.zeros(points.shape[:2]), np.zeros(points.shape[:2])
    one, two, everything = slice(1, None), slice(None, -1), slice(None)
    for here, beside in (
        ((one, everything), (two, everything)), ((two, everything), (one, everything)),
        ((everything, one), (everything, two)), ((everything, two), (everything, one)),
    ):  # fmt: skip
        told = uv[beside] + np.einsum("ijkl,ijl->ijk", maps[beside], points[here] - points[beside])
        off = np.linalg.norm(uv[here] - told, axis=2)
        there[here] += np.isfinite(off)
        agree[here] += off <= grid.step / 2
    return found.only((2 * agree >= np.maximum(there, 1)).ravel())


def _without(grid: Grid, found: Matches | None) -> Grid:
    """A grid without the places that are found."""
    return grid if found is None else replace(grid, points=np.where(found.found[:, None], np.nan, grid.points))


_LARGEST = 1200  # [px] of an image in which features are sought: theirs are larger than grains of texture
_RATIO = 0.8  # Lowe's: of the distances of the best and the second descriptor, below which a feature is no repeated one
_BESIDE = 2.0  # [px of the image searched] that a feature may lie beside the lines of sight: three of its deviations


def sift_seeds(
    first: SplineImage,
    second: SplineImage,
    cameras: tuple[Camera, Camera] | None = None,
    *,
    mask: NDArray | None = None,
    count: int = 200,
) -> Seeds:
    """Features that agree in both images, the surest first; each with its turn and scale as deformation.

    Parameters
    ----------
    cameras : of the two images, if calibrated: features whose rays miss each other are left out
    mask : (H, W) bool, of the first image
    count : at most so many

    Returns
    -------
    Seeds
        Without any where the images share nothing, or their texture repeats.
    """
    features = [_features(image, mask if k == 0 else None) for k, image in enumerate((first, second))]
    (points1, turns1, found1), (points2, turns2, found2) = features
    nothing = Seeds(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    if found1 is None or found2 is None or min(len(found1), len(found2)) < 2:
        return nothing
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(found1, found2, k=2)
    told = sorted(
        (a.distance / max(b.distance, 1e-9), a.queryIdx, a.trainIdx) for a, b in (p for p in pairs if len(p) == 2)
    )
    told = [pair for pair in told if pair[0] < _RATIO]
    if not told:
        return nothing
    i, j = (np.array([pair[k] for pair in told]) for k in (1, 2))
    one, two = points1[i], points2[j]
    deformation = turns2[j] @ np.linalg.inv(turns1[i])
    keep = np.arange(len(one))
    if cameras is not None:
        scale = max(max(first.size), max(second.size)) / _LARGEST
        seen = np.stack([one, two], axis=1)
        _, agree, _ = triangulate_robust(Rig(cameras), seen, max_residual_px=_BESIDE * max(scale, 1.0))
        keep = np.flatnonzero(agree.all(axis=1))
    keep = keep[:count]
    return Seeds(one[keep], two[keep], deformation[keep])


def _features(image: SplineImage, mask: NDArray | None) -> tuple[NDArray, NDArray, NDArray | None]:
    """Places (K, 2) [px], turns and scales (K, 2, 2), and descriptors of features; strongest first."""
    scale = min(1.0, _LARGEST / max(image.size))
    pixels = cv2.resize(image.grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image.grey
    low, high = np.percentile(pixels, (1, 99))
    pixels = np.clip((pixels - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    area = None
    if mask is not None:
        area = cv2.resize(np.asarray(mask, np.uint8), pixels.shape[::-1], interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT_create(3000)  # type: ignore[attr-defined]
    keys, descriptors = sift.detectAndCompute(pixels, area)
    points = np.array([key.pt for key in keys]).reshape(-1, 2)
    angle, size = np.deg2rad([key.angle for key in keys]), np.array([key.size for key in keys])
    cos, sin = size * np.cos(angle), size * np.sin(angle)
    turns = np.stack([cos, -sin, sin, cos], axis=-1).reshape(-1, 2, 2)
    return (points + 0.5) / scale - 0.5, turns, descriptors


WINDOW = 17  # [px] of windows that are sought: narrower ones look alike somewhere on a line of a thousand pixels
_CORNERS = 48  # of a line, evenly spaced in 1 / distance
_NEAREST, _FARTHEST = 0.5, 200.0  # distances between the cameras, between which a point is
_LEAST = 0.6  # correlation: pixels are read to the nearest, and a surface may be inclined to both cameras
TEXTURE = 3.0  # deviations of the noise, above which grey values of a window scatter
_STRAIGHT = 1e-3  # [rad] by which the ray of an image may miss its point: a lens model that folds back


def ray_seeds(
    first: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], points: ArrayLike
) -> tuple[Seeds, NDArray[np.int64]]:
    """Points of the first image that are found, and found once, on their lines of sight in the second.

    The surface is taken to face the middle of both cameras, which gives the window's turn and shear at every distance.

    Parameters
    ----------
    cameras : of the two images
    points : (S, 2) [px] in the first image; they are taken to the nearest pixel

    Returns
    -------
    Seeds
        Of those that were found.
    index : (K,) of them among the points
    """
    at = np.rint(places(points))
    lines, maps = _lines(cameras, at)
    uv, found = np.empty_like(at), np.empty((len(at), 4))
    best, runner_up = np.empty(len(at)), np.empty(len(at))
    least = (TEXTURE * first.noise) ** 2
    kernels.search_lines(first.grey, second.grey, at, lines, maps, WINDOW // 2, least, uv, found, best, runner_up)
    good = np.flatnonzero((best >= _LEAST) & (runner_up < _UNIQUE * best))
    return Seeds(at[good], uv[good], found[good].reshape(-1, 2, 2)), good


def _lines(cameras: tuple[Camera, Camera], at: NDArray) -> tuple[NDArray, NDArray]:
    """Places (S, K, 2) [px] in the second image of points on the rays of the first, and maps (S, K, 4)."""
    one, two = cameras
    base = float(np.linalg.norm(one.centre_world - two.centre_world))
    distance = base / np.linspace(1.0 / _NEAREST, 1.0 / _FARTHEST, _CORNERS)
    ray = one.ray(at)
    beside = [one.ray(at + step) - ray for step in np.eye(2)]
    x = one.centre_world + distance[:, None] * ray[:, None]
    uv, J = two.project_with_jacobian(x)
    back = x - two.centre_world
    back /= np.linalg.norm(back, axis=2, keepdims=True)
    normal = ray[:, None] + back
    inclined = np.einsum("ski,si->sk", normal, ray)
    out = np.empty((*uv.shape, 2))
    for k, step in enumerate(beside):
        across = step[:, None] - ray[:, None] * (np.einsum("ski,si->sk", normal, step) / inclined)[..., None]
        out[..., k] = np.einsum("skij,skj->ski", J, distance[:, None] * across)
    inside = ((uv > 0) & (uv < np.array(two.size))).all(axis=2, keepdims=True)
    uv = np.where(inside, uv, np.nan)
    bent = np.linalg.norm(two.ray(uv) - back, axis=2, keepdims=True)
    uv = np.where(bent < _STRAIGHT, uv, np.nan)
    return np.ascontiguousarray(uv), np.ascontiguousarray(out.reshape(*uv.shape[:2], 4))
