"""Where cameras stand to each other, from unordered pairs of targets, with no pose and perhaps no lens known.

No image tells which of the two targets is which: every step tries both orders and keeps the one that fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import exp_so3, transform

FEWEST = 12  # places that two cameras share: 48 coordinates for 7 unknowns of their orientation, with orders unknown
_HYPOTHESES = 1500  # a sample of four places has its orders right once in eight
_NEAR = 0.01  # of the image's width: an unknown lens bends lines by as much
_NEAR_KNOWN = 3.0  # [px] where the lens is known
_FOCALS = np.geomspace(0.4, 4.0, 25)  # focal length over the image's longer side: 100 to 14 degrees wide
_AGREE = 0.6  # of the places that two cameras share
_PARALLAX = np.radians(2.0)  # between rays, below which distances are chance


@dataclass(frozen=True, eq=False)
class Pair:
    """Two cameras that agree: places in the rig, cameras with focal length and pose, share of places that agree."""

    first: int
    second: int
    cameras: tuple[Camera, Camera]
    agree: float
    worth: float


def flat(camera: Camera, uv: NDArray, known: bool) -> NDArray:
    """Image coordinates that are perspective: with a known lens those at distance 1, else widths from the centre."""
    if known:
        ray = camera.with_pose(np.eye(4)).ray(uv)
        return ray[..., :2] / np.where(ray[..., 2:] > 1e-6, ray[..., 2:], np.nan)
    return (uv - (np.array(camera.size) - 1) / 2) / max(camera.size)


def with_focal(camera: Camera, focal: float, known: bool) -> Camera:
    """A camera of a focal length [widths], centred and without distortion; unchanged where its lens is known."""
    if known:
        return camera
    f = focal * max(camera.size)
    centre = (np.array(camera.size) - 1) / 2
    K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
    return replace(camera, matrix=K, distortion=np.zeros(5), model="radtan")


def near(camera: Camera, known: bool) -> float:
    """Distance in flat coordinates within which measurements agree."""
    return _NEAR_KNOWN / camera.matrix[0, 0] if known else _NEAR


def first_pairs(cameras: Sequence[Camera], uv: NDArray, known: bool, length: float) -> list[Pair]:
    """Pairs of cameras to begin with, best first; several focal lengths of one pair may stand in the list.

    Parameters
    ----------
    cameras : of which lens and size count.
    uv : (F, C, 2, 2) [px] of place, camera, target.

    Raises
    ------
    CalibrationError
        Too few common places, targets that do not belong together, or that all lie in a plane.
    """
    seen = np.isfinite(uv).all(axis=(2, 3))
    shared = {(i, j): int((seen[:, i] & seen[:, j]).sum()) for i, j in combinations(range(len(cameras)), 2)}
    enough = {pair: n for pair, n in shared.items() if n >= FEWEST}
    if not enough:
        (i, j), most = max(shared.items(), key=lambda item: item[1])
        raise CalibrationError(
            f"no two cameras see the bar in {FEWEST} common places; {cameras[i].name} and {cameras[j].name} in {most}",
            remedy="Wave the bar where two cameras see both targets at a time; 50 places and more, over all the volume."
        )
    pairs: list[Pair] = []
    told: dict[str, float] = {}
    for i, j in sorted(enough, key=lambda pair: -enough[pair])[:8]:
        both = seen[:, i] & seen[:, j]
        a, b = flat(cameras[i], uv[both, i], known), flat(cameras[j], uv[both, j], known)
        limit = max(near(cameras[i], known), near(cameras[j], known))
        F, order, inside = epipolar(a, b, limit)
        share = float(inside.mean())
        name = f"{cameras[i].name} and {cameras[j].name}"
        if share < _AGREE:
            told[f"{name} agree in {100 * share:.0f} % of {both.sum()} places"] = share
            continue
        b = np.where(order[:, None, None], b[:, ::-1], b)
        if _is_flat(a[inside], b[inside], limit):
            told[f"all places that {name} share lie in one plane, or they stand all but in one place"] = 1.0
            continue
        for metric, gain in _metric((cameras[i], cameras[j]), F, a[inside], b[inside], known, length):
            pairs.append(Pair(i, j, metric, share, gain * share))
    if not pairs:
        worst = max(told, key=lambda text: told[text]) if told else "no two cameras see it from sides that differ"
        flatness = "plane" in worst
        raise CalibrationError(
            f"the targets do not tell how the cameras stand: {worst}",
            remedy="Wave the bar near and far, high and low, in all directions." if flatness
            else "Are the videos in step, and the two targets the brightest spots? Set the cameras farther apart.",
        )  # fmt: skip
    return sorted(pairs, key=lambda pair: -pair.worth)


def epipolar(a: NDArray, b: NDArray, limit: float) -> tuple[NDArray, NDArray, NDArray]:
    """Fundamental matrix of unordered pairs of points by consensus, with the orders that fit it.

    Parameters
    ----------
    a, b : (M, 2, 2) flat coordinates of two targets in two cameras.

    Returns
    -------
    F : (3, 3) with x_bᵀ F x_a = 0
    exchanged : (M,) bool, where the targets of b stand the other way round.
    inside : (M,) bool, places that agree.
    """
    return _consensus(a, b, _eight_points, _order_costs, limit, rounds=10, least=4)


def _consensus(
    a: NDArray, b: NDArray, model_of: Callable[[NDArray, NDArray], NDArray],
    costs: Callable[[NDArray, NDArray, NDArray], NDArray], limit: float, *, rounds: int, least: int,
) -> tuple[NDArray, NDArray, NDArray]:  # fmt: skip
    """The model of pairs a (M, 2, n) and b (M, 2, 2), whose order is unknown, that most agree with; see `epipolar`.

    It is found from four pairs at a time, then from all that agree, in so many rounds, while `least` do.
    """
    rng, M = np.random.default_rng(0), len(a)
    sample = rng.integers(0, M, (_HYPOTHESES, 4))
    swap = rng.random((_HYPOTHESES, 4)) < 0.5
    bs = np.where(swap[:, :, None, None], b[sample][:, :, ::-1], b[sample])
    models = model_of(a[sample].reshape(_HYPOTHESES, 8, -1), bs.reshape(_HYPOTHESES, 8, 2))
    few = np.unique(np.linspace(0, M - 1, min(M, 150)).astype(int))
    best = int(np.argmin(np.minimum(costs(models, a[few], b[few]).min(axis=0), 2 * limit**2).sum(axis=1)))
    model, exchanged, inside = models[best][None], np.zeros(M, bool), np.ones(M, bool)
    for _ in range(rounds):
        straight, crossed = costs(model, a, b)[:, 0]
        exchanged, inside = crossed < straight, np.minimum(straight, crossed) < 2 * limit**2
        if inside.sum() < least:
            break
        ordered = np.where(exchanged[:, None, None], b[:, ::-1], b)[inside]
        model = model_of(a[inside].reshape(1, 2 * inside.sum(), -1), ordered.reshape(1, -1, 2))
    return model[0], exchanged, inside


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
    """(2, K, M) squared Sampson distances of both targets in sum, straight and exchanged."""
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
    """Whether all targets lie in one plane: a homography explains the second image as well as the first allows."""
    H, _ = cv2.findHomography(a.reshape(-1, 2), b.reshape(-1, 2), cv2.LMEDS)
    if H is None:
        return False
    off = np.linalg.norm(cv2.perspectiveTransform(a.reshape(1, -1, 2), H)[0] - b.reshape(-1, 2), axis=1)
    return bool(np.median(off) < limit)


def _metric(
    cameras: tuple[Camera, Camera], F: NDArray, a: NDArray, b: NDArray, known: bool, length: float
) -> list[tuple[tuple[Camera, Camera], float]]:
    """Cameras with which the bar keeps its length, by focal lengths and the poses of these, and what each is worth."""
    few = np.unique(np.linspace(0, len(a) - 1, min(len(a), 80)).astype(int))
    focals = np.ones(1) if known else _FOCALS
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
            if angle > _PARALLAX:
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


def _alike(one: tuple[Camera, Camera], other: tuple[Camera, Camera]) -> bool:
    return all(abs(np.log(p.matrix[0, 0] / q.matrix[0, 0])) < 0.25 for p, q in zip(one, other))


def _posed(E: NDArray, a: NDArray, b: NDArray) -> tuple[NDArray, NDArray, float, float] | None:
    """T_b_a with |t| = 1, lengths of the bar (M,), median angle of the rays, share in front: the best of four poses."""
    u, _, vt = np.linalg.svd(E)
    W = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rays = [np.concatenate([p.reshape(-1, 2), np.ones((p.size // 2, 1))], axis=1) for p in (a, b)]
    best = None
    for R in (u @ W @ vt, u @ W.T @ vt):
        R = R * np.sign(np.linalg.det(R))
        for t in (u[:, 2], -u[:, 2]):
            # rays s p from the first, s' Rᵀ q from the second at -Rᵀ t: nearest points
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
    """A camera laid on the bar's known places, and the share of places that agree.

    Parameters
    ----------
    x_world : (M, 2, 3) [m] ends.
    uv : (M, 2, 2) [px] targets, in any order.
    """
    if len(uv) < FEWEST:
        return camera, 0.0
    p, limit = flat(camera, uv, known), near(camera, known)
    middle, size = x_world.mean(axis=(0, 1)), max(float(x_world.std()), 1e-9)
    x = np.concatenate([(x_world - middle) / size, np.ones((len(uv), 2, 1))], axis=2)
    _, exchanged, inside = _consensus(x, p, _direct, _projected, limit, rounds=8, least=6)
    if inside.sum() < 6:
        return camera, 0.0
    ordered = np.where(exchanged[:, None, None], p[:, ::-1], p)
    best_cost, best_camera = np.inf, camera
    for focal in np.ones(1) if known else _FOCALS:
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
    """(2, K, M) squared distances of both targets in sum, straight and exchanged."""
    seen = np.einsum("kij,mej->kmei", P, x)
    depth = np.where(np.abs(seen[..., 2:]) > 1e-12, seen[..., 2:], 1e-12)
    seen = seen[..., :2] / depth
    return np.array([((seen - p[None][:, :, order]) ** 2).sum(axis=(2, 3)) for order in ((0, 1), (1, 0))])
