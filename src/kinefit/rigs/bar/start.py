"""Initial relative poses of cameras from unordered pairs of targets, with or without known intrinsics.

No image distinguishes the two targets: every step tries both orders and keeps the one that fits.

Triangulate the bar in every frame, and assign its targets in every camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate
from kinefit.geometry.se3 import exp_so3, transform

MIN_PLACES = 12  # that two cameras share: 48 coordinates for 7 unknowns of their orientation, with orders unknown
_HYPOTHESES = 1500  # one in eight samples of four places has the right orders
_MAX_ERROR = 0.01  # of the image's width: the distortion of an unknown lens
_MAX_ERROR_KNOWN_LENS_PX = 3.0
_RESECTION_ERRORS = 3.0  # as many times the error of an inlier: ends known from two cameras are off in depth
_TRIED_FOCALS = np.geomspace(0.4, 4.0, 25)  # focal length over the image's longer side: 100 to 14 degrees wide
_MIN_AGREEING_SHARE = 0.6  # of the places that two cameras share
_MIN_PARALLAX = np.radians(2.0)  # between rays: with less distances are undetermined


@dataclass(frozen=True, eq=False)
class Pair:
    """Two cameras that agree: indices in the rig, cameras with focal length and pose, score."""

    first: int
    second: int
    cameras: tuple[Camera, Camera]
    worth: float


def flat(camera: Camera, uv: NDArray, known: bool) -> NDArray:
    """Perspective coordinates (..., 2) of pixels uv (..., 2): normalised if the lens is known, else in image widths."""
    if known:
        ray = camera.with_pose(np.eye(4)).ray(uv)
        return ray[..., :2] / np.where(ray[..., 2:] > 1e-6, ray[..., 2:], np.nan)
    return (uv - (np.array(camera.size) - 1) / 2) / max(camera.size)


def with_focal(camera: Camera, focal: float, known: bool) -> Camera:
    """A camera of a focal length [image widths], centred and without distortion; unchanged if its lens is known."""
    if known:
        return camera
    f = focal * max(camera.size)
    centre = (np.array(camera.size) - 1) / 2
    K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
    return replace(camera, matrix=K, distortion=np.zeros(5), model="radtan")


def inlier_distance(camera: Camera, known: bool) -> float:
    """Largest error of an inlier in the unit of `flat`: image widths, or normalised coordinates of a known lens."""
    return _MAX_ERROR_KNOWN_LENS_PX / camera.matrix[0, 0] if known else _MAX_ERROR


def first_pairs(cameras: Sequence[Camera], uv: NDArray, known: bool, length: float) -> list[Pair]:
    """Initial pairs of cameras, best first; one pair may occur with several focal lengths.

    Parameters
    ----------
    cameras : with their lenses and image sizes.
    uv : (F, C, 2, 2) [px] of place, camera, target.

    Raises
    ------
    CalibrationError
        Too few common places, targets that do not match, or all targets in one plane.
    """
    seen = np.isfinite(uv).all(axis=(2, 3))
    shared = {(i, j): int((seen[:, i] & seen[:, j]).sum()) for i, j in combinations(range(len(cameras)), 2)}
    enough = {pair: n for pair, n in shared.items() if n >= MIN_PLACES}
    if not enough:
        (i, j), most = max(shared.items(), key=lambda item: item[1])
        raise CalibrationError(
            f"no two cameras see the bar in {MIN_PLACES} common places; "
            f"{cameras[i].name} and {cameras[j].name} in {most}",
            remedy="Wave the bar where two cameras see both targets at a time; 50 places and more, over all the volume."
        )
    pairs: list[Pair] = []
    reasons: dict[str, float] = {}
    for i, j in sorted(enough, key=lambda pair: -enough[pair])[:8]:
        both = seen[:, i] & seen[:, j]
        a, b = flat(cameras[i], uv[both, i], known), flat(cameras[j], uv[both, j], known)
        limit = max(inlier_distance(cameras[i], known), inlier_distance(cameras[j], known))
        F, order, inside = epipolar(a, b, limit)
        share = float(inside.mean())
        name = f"{cameras[i].name} and {cameras[j].name}"
        if share < _MIN_AGREEING_SHARE:
            reasons[f"{name} agree in {100 * share:.0f} % of {both.sum()} places"] = share
            continue
        b = np.where(order[:, None, None], b[:, ::-1], b)
        if _is_flat(a[inside], b[inside], limit):
            reasons[f"all places that {name} share lie in one plane, or both cameras are nearly in one place"] = 1.0
            continue
        for metric, gain in _metric((cameras[i], cameras[j]), F, a[inside], b[inside], known, length):
            pairs.append(Pair(i, j, metric, gain * share))
    if not pairs:
        worst = max(reasons, key=reasons.__getitem__, default="no two cameras see it from different sides")
        flatness = "plane" in worst
        raise CalibrationError(
            f"the targets do not determine the cameras' poses: {worst}",
            remedy="Wave the bar near and far, high and low, in all directions." if flatness
            else "Check that the videos are in step and the targets the brightest spots. Move the cameras apart.",
        )  # fmt: skip
    return sorted(pairs, key=lambda pair: -pair.worth)


def epipolar(a: NDArray, b: NDArray, limit: float) -> tuple[NDArray, NDArray, NDArray]:
    """Fundamental matrix of unordered pairs of points by random sampling, with the orders that fit it.

    Parameters
    ----------
    a, b : (M, 2, 2) flat coordinates of two targets in two cameras.

    Returns
    -------
    F : (3, 3) with x_bᵀ F x_a = 0
    swapped : (M,) bool, places with swapped targets in b.
    inside : (M,) bool, inliers.
    """
    return _consensus(a, b, _eight_points, _order_costs, limit, rounds=10, least=4)


def _consensus(
    a: NDArray, b: NDArray, model_of: Callable[[NDArray, NDArray], NDArray],
    costs: Callable[[NDArray, NDArray, NDArray], NDArray], limit: float, *, rounds: int, least: int,
) -> tuple[NDArray, NDArray, NDArray]:  # fmt: skip
    """The model with the lowest robust cost of pairs a (M, 2, n) and b (M, 2, 2) of unknown order; see `epipolar`.

    Hypotheses are from four pairs; the best is refined by its inliers in some rounds, while there are `least`.
    """
    rng, M = np.random.default_rng(0), len(a)
    sample = rng.integers(0, M, (_HYPOTHESES, 4))
    swap = rng.random((_HYPOTHESES, 4)) < 0.5
    bs = np.where(swap[:, :, None, None], b[sample][:, :, ::-1], b[sample])
    models = model_of(a[sample].reshape(_HYPOTHESES, 8, -1), bs.reshape(_HYPOTHESES, 8, 2))
    few = np.unique(np.linspace(0, M - 1, min(M, 150)).astype(int))
    best = int(np.argmin(np.minimum(costs(models, a[few], b[few]).min(axis=0), 2 * limit**2).sum(axis=1)))
    model, swapped, inside = models[best][None], np.zeros(M, bool), np.ones(M, bool)
    for _ in range(rounds):
        straight, crossed = costs(model, a, b)[:, 0]
        swapped, inside = crossed < straight, np.minimum(straight, crossed) < 2 * limit**2
        if inside.sum() < least:
            break
        ordered = np.where(swapped[:, None, None], b[:, ::-1], b)[inside]
        model = model_of(a[inside].reshape(1, 2 * inside.sum(), -1), ordered.reshape(1, -1, 2))
    return model[0], swapped, inside


def _eight_points(a: NDArray, b: NDArray) -> NDArray:
    """(K, 3, 3) of points (K, N, 2): R. Hartley, In defense of the eight-point algorithm, 1997."""
    def normal(x: NDArray) -> tuple[NDArray, NDArray]:
        middle = x.mean(axis=1)
        size = np.maximum(np.sqrt(((x - middle[:, None]) ** 2).sum(axis=2).mean(axis=1) / 2), 1e-9)
        T = np.zeros((len(x), 3, 3))
        T[:, 0, 0] = T[:, 1, 1] = 1.0 / size
        T[:, :2, 2], T[:, 2, 2] = -middle / size[:, None], 1.0
        return np.concatenate([(x - middle[:, None]) / size[:, None, None], np.ones((*x.shape[:2], 1))], axis=2), T

    (x, Ta), (y, Tb) = normal(a), normal(b)
    A = (y[..., :, None] * x[..., None, :]).reshape(*x.shape[:2], 9)
    F = np.linalg.svd(A, full_matrices=True)[2][:, -1].reshape(-1, 3, 3) if A.shape[1] < 40 else np.linalg.eigh(
        np.swapaxes(A, 1, 2) @ A
    )[1][:, :, 0].reshape(-1, 3, 3)
    u, s, vt = np.linalg.svd(F)
    s[:, 2] = 0.0
    F = np.swapaxes(Tb, 1, 2) @ ((u * s[:, None, :]) @ vt) @ Ta
    return F / np.linalg.norm(F, axis=(1, 2), keepdims=True)


def _order_costs(F: NDArray, a: NDArray, b: NDArray) -> NDArray:
    """(2, K, M) sums of squared Sampson distances of both targets, in order and swapped."""
    x, y = (np.concatenate([p, np.ones((*p.shape[:2], 1))], axis=2) for p in (a, b))
    lines = np.einsum("kij,mej->kmei", F, x)
    back = np.einsum("kji,mej->kmei", F, y)
    out = []
    for order in ((0, 1), (1, 0)):
        error = np.einsum("mei,kmei->kme", y[:, order], lines)
        size = (lines[..., :2] ** 2).sum(-1) + (back[:, :, order, :2] ** 2).sum(-1)
        out.append((error**2 / np.maximum(size, 1e-18)).sum(axis=2))
    return np.array(out)


def _is_flat(a: NDArray, b: NDArray, limit: float) -> bool:
    """Whether all targets lie in one plane: a homography maps the first image to the second within the limit."""
    H, _ = cv2.findHomography(a.reshape(-1, 2), b.reshape(-1, 2), cv2.LMEDS)
    if H is None:
        return False
    off = np.linalg.norm(cv2.perspectiveTransform(a.reshape(1, -1, 2), H)[0] - b.reshape(-1, 2), axis=1)
    return bool(np.median(off) < limit)


def _metric(
    cameras: tuple[Camera, Camera], F: NDArray, a: NDArray, b: NDArray, known: bool, length: float
) -> list[tuple[tuple[Camera, Camera], float]]:
    """Pairs of cameras for which the bar keeps its length, over focal lengths and their poses, with a score each."""
    few = np.unique(np.linspace(0, len(a) - 1, min(len(a), 80)).astype(int))
    focals = np.ones(1) if known else _TRIED_FOCALS
    trials = []
    for fi in focals:
        for fj in focals:
            E = np.diag([fj, fj, 1.0]) @ F @ np.diag([fi, fi, 1.0])
            s = np.linalg.svd(E, compute_uv=False)
            found = _posed(E, a[few] / fi, b[few] / fj)
            if found is None:
                continue
            T, lengths, angle, front = found
            middle = np.median(lengths)
            spread = float(np.median(np.abs(np.log(lengths / middle)))) if middle > 0 else np.inf
            if angle > _MIN_PARALLAX:
                trials.append((spread + 0.5 * (1 - s[1] / s[0]) + 2 * (1 - front), fi, fj, T, middle, angle))
    trials.sort(key=lambda trial: trial[0])
    chosen: list[tuple[tuple[Camera, Camera], float]] = []
    for cost, fi, fj, T, middle, angle in trials:
        if cost > 2 * trials[0][0] + 0.02 or len(chosen) == 4:
            break
        T = T.copy()
        T[:3, 3] *= length / middle
        pair = with_focal(cameras[0], fi, known).with_pose(np.eye(4)), with_focal(cameras[1], fj, known).with_pose(T)
        if not any(_alike(pair, other) for other, _ in chosen) or known:
            chosen.append((pair, len(a) * np.sin(angle) / (0.02 + cost)))
    return chosen


def _alike(a: tuple[Camera, Camera], b: tuple[Camera, Camera]) -> bool:
    return all(abs(np.log(p.matrix[0, 0] / q.matrix[0, 0])) < 0.25 for p, q in zip(a, b))


def _posed(E: NDArray, a: NDArray, b: NDArray) -> tuple[NDArray, NDArray, float, float] | None:
    """T_b_a with |t| = 1, lengths of the bar (M,), median angle of the rays, share in front: the best of four poses."""
    R_a, R_b, way = cv2.decomposeEssentialMat(E)
    rays = [np.concatenate([p.reshape(-1, 2), np.ones((p.size // 2, 1))], axis=1) for p in (a, b)]
    best = None
    for R in (R_a, R_b):
        for t in (way.ravel(), -way.ravel()):
            # nearest points of the rays s p from the first camera and r Rᵀ q from the second at -Rᵀ t
            p, q, centre = rays[0], rays[1] @ R, -R.T @ t
            pp, qq, pq = (np.sum(x * y, axis=1) for x, y in ((p, p), (q, q), (p, q)))
            pc, qc = p @ centre, q @ centre
            below = np.maximum(pp * qq - pq**2, 1e-15)
            s, r = (qq * pc - pq * qc) / below, (pq * pc - pp * qc) / below
            front = float(np.mean((s > 0) & (r > 0)))
            if best is None or front > best[3]:
                x = 0.5 * (s[:, None] * p + r[:, None] * q + centre).reshape(-1, 2, 3)
                angle = float(np.median(np.arccos(np.clip(pq / np.sqrt(pp * qq), -1, 1))))
                best = (transform(R, t), np.linalg.norm(x[:, 1] - x[:, 0], axis=1), angle, front)
    return best if best is not None and best[3] > 0.5 else None


def resect(camera: Camera, x_world: NDArray, uv: NDArray, known: bool) -> tuple[Camera, float]:
    """Resect a camera from the bar's known ends; returns it with the share of places that agree.

    Parameters
    ----------
    x_world : (M, 2, 3) [m] ends.
    uv : (M, 2, 2) [px] targets, in any order.
    """
    if len(uv) < MIN_PLACES:
        return camera, 0.0
    p, limit = flat(camera, uv, known), inlier_distance(camera, known) * (_RESECTION_ERRORS if known else 1.0)
    middle, size = x_world.mean(axis=(0, 1)), max(float(x_world.std()), 1e-9)
    x = np.concatenate([(x_world - middle) / size, np.ones((len(uv), 2, 1))], axis=2)
    _, swapped, inside = _consensus(x, p, _direct, _projected, limit, rounds=8, least=6)
    if inside.sum() < 6:
        return camera, 0.0
    ordered = np.where(swapped[:, None, None], p[:, ::-1], p)
    best_cost, best_camera = np.inf, camera
    for focal in np.ones(1) if known else _TRIED_FOCALS:
        image = np.ascontiguousarray(ordered[inside].reshape(-1, 2) / focal)
        ok, turn, shift = cv2.solvePnP(
            np.ascontiguousarray(x_world[inside].reshape(-1, 3)), image, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not ok:
            continue
        R = exp_so3(turn.ravel())
        seen = x_world[inside].reshape(-1, 3) @ R.T + shift.ravel()
        if seen[:, 2].min() <= 0:
            continue
        cost = focal * float(np.median(np.linalg.norm(seen[:, :2] / seen[:, 2:] - image, axis=1)))
        if cost < best_cost:
            best_cost = cost
            best_camera = with_focal(camera, float(focal), known).with_pose(transform(R, shift.ravel()))
    return best_camera, float(inside.mean()) if np.isfinite(best_cost) else 0.0


def _direct(x: NDArray, p: NDArray) -> NDArray:
    """(K, 3, 4) projection matrices of points (K, N, 4) seen at (K, N, 2): direct linear transformation."""
    A = np.zeros((*x.shape[:2], 2, 12))
    A[:, :, 0, :4] = A[:, :, 1, 4:8] = x
    A[..., 8:] = -p[..., :, None] * x[:, :, None, :]
    A = A.reshape(len(x), -1, 12)
    return np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)[1][:, :, 0].reshape(-1, 3, 4)


def _projected(P: NDArray, x: NDArray, p: NDArray) -> NDArray:
    """(2, K, M) sums of squared distances of both targets, in order and swapped."""
    seen = np.einsum("kij,mej->kmei", P, x)
    depth = np.where(np.abs(seen[..., 2:]) > 1e-12, seen[..., 2:], 1e-12)
    seen = seen[..., :2] / depth
    return np.array([((seen - p[None][:, :, order]) ** 2).sum(axis=(2, 3)) for order in ((0, 1), (1, 0))])


@dataclass(frozen=True, eq=False)
class BarPlacement:
    """Ends (F, 2, 3) [m], NaN where unknown; pixels (F, C, 2, 2) in their order, NaN where unused; ambiguous (F,)."""

    x_world: NDArray
    uv: NDArray
    ambiguous: NDArray


def place(rig: Rig, uv: NDArray, length: float, limit: float, tolerance: float) -> BarPlacement:
    """Triangulate the bar in every frame, in the order of targets with the lowest cost in all cameras and the length.

    Frames in which two orders fit alike (two cameras and a bar in the plane through both) are discarded.

    Parameters
    ----------
    uv : (F, C, 2, 2) [px], targets in any order.
    limit : float [px] largest error of a camera that agrees.
    tolerance : float [m] standard deviation of the length.
    """
    F, C = uv.shape[:2]
    seen = np.isfinite(uv).all(axis=(2, 3))
    costs, ends, orders = [np.full(F, np.inf)], [np.full((F, 2, 3), np.nan)], [np.zeros((F, C), bool)]
    for i, j in combinations(range(C), 2):
        both = np.flatnonzero(seen[:, i] & seen[:, j])
        pair = Rig((rig.cameras[i], rig.cameras[j]))
        for crossed in (False, True) if len(both) else ():
            pixels = np.stack([uv[both, i], uv[both, j][:, ::-1] if crossed else uv[both, j]], axis=2)
            cost, x, order = np.full(F, np.inf), np.full((F, 2, 3), np.nan), np.zeros((F, C), bool)
            x[both] = triangulate(pair, pixels.reshape(-1, 2, 2)).reshape(-1, 2, 3)
            off = (np.linalg.norm(x[both, 1] - x[both, 0], axis=1) - length) / tolerance
            agreed, order[both] = _agreement(rig, x[both], uv[both], limit)
            cost[both] = agreed + np.minimum(np.nan_to_num(off**2), 25.0)
            costs, ends, orders = [*costs, cost], [*ends, x], [*orders, order]
    rows, best = np.arange(F), np.argmin(costs, axis=0)
    x_world, order = np.array(ends)[best, rows], np.array(orders)[best, rows]
    differs = (np.array(orders) ^ order) & seen
    other = differs.any(axis=2) & (differs != seen).any(axis=2)  # all swapped is the same bar
    rival = np.where(other, costs, np.inf).min(axis=0)
    least = np.array(costs)[best, rows]
    ambiguous = np.isfinite(least) & (rival < least + 9.0)  # three standard deviations
    ordered = np.where(order[:, :, None, None], uv[:, :, ::-1], uv)
    projected = np.stack([camera.project(np.nan_to_num(x_world)) for camera in rig], axis=1)
    off = np.linalg.norm(projected - ordered, axis=3).max(axis=2)
    used = seen & (off < limit) & ~ambiguous[:, None]
    keeps = np.abs(np.linalg.norm(x_world[:, 1] - x_world[:, 0], axis=1) - length) < 5 * tolerance
    used &= ((used.sum(axis=1) >= 2) & keeps)[:, None]
    x_world[~used.any(axis=1)] = np.nan
    return BarPlacement(x_world, np.where(used[:, :, None, None], ordered, np.nan), ambiguous)


def _agreement(rig: Rig, x: NDArray, uv: NDArray, limit: float) -> tuple[NDArray, NDArray]:
    """Truncated costs (F,) of ends x (F, 2, 3), a third of the limit counting 1, and (F, C) cameras that swap them."""
    cost, exchanged = np.zeros(len(x)), np.zeros(uv.shape[:2], bool)
    for c, camera in enumerate(rig):
        seen = np.isfinite(uv[:, c]).all(axis=(1, 2))
        at = camera.project(np.nan_to_num(x))
        both = [np.sum((at - uv[:, c][:, order]) ** 2, axis=(1, 2)) for order in ((0, 1), (1, 0))]
        both = [np.where(np.isfinite(square), square, np.inf) for square in both]
        exchanged[:, c] = both[1] < both[0]
        cost += np.where(seen, np.minimum(np.minimum(*both), 2 * limit**2), 0.0) / (limit / 3) ** 2
    return np.where(np.isfinite(x).all(axis=(1, 2)), cost, np.inf), exchanged


_MIN_FLOOR_ASPECT = 0.1  # width over length of the points on the floor: narrower ones determine no plane


def on_floor(rig: Rig, x_world: NDArray, frames: NDArray, floor: Sequence[int]) -> tuple[Rig, NDArray, str]:
    """The rig in the requested world, T_new_world (4, 4), and a description of that world.

    Parameters
    ----------
    x_world : (F, 2, 3) [m] ends of the bar; frames (F,) their numbers.
    floor : frames in which the bar lies on the floor; empty: the world stays.

    Raises
    ------
    CalibrationError
        A frame without the bar, or points on one line.
    """
    first = rig.names[0]
    if not floor:
        return rig, np.eye(4), (
            f"The world is the frame of {first} (x right, y down, z forward in its image): its -y points up if {first} "
            "was level. Lay the bar on the floor in two directions and name the frames to have z up."
        )  # fmt: skip
    absent = [frame for frame in floor if frame not in frames]
    if absent:
        nearest = int(frames[np.argmin(np.abs(frames - absent[0]))])
        raise CalibrationError(
            f"two cameras do not see the bar in frame {absent[0]}, in which it should lie on the floor", place="floor",
            remedy=f"The nearest frame with the bar is {nearest}; the last is {int(frames[-1])}.",
        )  # fmt: skip
    points = x_world[np.searchsorted(frames, np.array(floor))].reshape(-1, 3)
    middle = points.mean(axis=0)
    size, axes = np.linalg.svd(points - middle)[1:]
    if len(floor) < 2 or size[1] < _MIN_FLOOR_ASPECT * size[0]:
        raise CalibrationError(
            "the bar on the floor lies along one line, which does not determine the vertical", place="floor",
            remedy="Lay it there in two directions, and give a frame of each.",
        )  # fmt: skip
    above = np.mean([camera.centre_world for camera in rig], axis=0) - middle
    up = axes[2] * np.sign(axes[2] @ above)
    along = points[1] - points[0]
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    R = np.stack([along, np.cross(up, along), up])
    T = transform(R, -R @ points[0])
    height = 1e3 * float(np.sqrt(np.mean(((points - middle) @ up) ** 2)))
    listed = ", ".join(map(str, floor))
    return rig.moved(T), T, (
        f"Origin in a target of the bar on the floor (frame {floor[0]}), x along the bar, z up; the targets of frames "
        f'{listed} lie in a plane to {height:.1f} mm RMS. Write up = "z" in the take.'
    )
