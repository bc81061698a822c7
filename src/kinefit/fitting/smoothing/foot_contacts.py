"""Find foot contacts: points of the soles that are low and slow, their places, and when contact starts and ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.motion import UP_AXES
from kinefit.findings import runs_of
from kinefit.geometry import se3

_SOLE_HEIGHT = 0.04  # [m] above the lowest landmark of the rest pose, below which a landmark belongs to a sole
_MAX_CONTACT_SPEED = 0.15  # [m/s]: a swinging foot reaches several m/s; a standing one seems to move by its noise
_MIN_RELEASE_SPEED = 0.30  # [m/s] that ends a contact: of 1 to 6 times `_MAX_CONTACT_SPEED`, in simulated jumps, all
# from 1.5 on end flicker, and none extends contact into flight (seeds 0 to 2, benchmark `closures_contacts`)
_MAX_CONTACT_HEIGHT = 0.04  # [m] above the point's contact height: a foot lifted to step exceeds it within few frames
_MIN_CONTACT_S = 0.1  # [s]: the shortest stance of a sprinter
_CONTACT_STD = 0.01  # [m] of a point in contact: soles and skin deform
_MIN_SWING_S = 0.15  # that a foot is in the air between two stances; where points are less sure than with calibration
_MAX_OFF_PLANE_M = 0.10  # of a sole before one camera, whose depth is that unsure: beyond, it rests on something else
_STANCE_SIGMA_M = 0.02  # of the height of a foot that stands, all its points together
_CAMERA_SIGMA = np.radians(6.0)  # by which one camera that is taken to look level is tilted
_MAX_CAMERA_TILT = 3.0 * _CAMERA_SIGMA  # beyond, its plane is no better than the prior was: feet stay where they seem
# to rest (balancing, two cameras turned by 25 and 31 degrees: joints 63 and 60 mm off, on the plane 71 and 77)
_BODY_SIGMA = np.radians(4.0)  # by which a person leans on average over a take


@dataclass(frozen=True, eq=False)
class FloorPlane:
    """The floor that feet rest on.

    Parameters
    ----------
    normal : (3,) unit vector, upwards
    place : (3,) [m] a point of it, amid the feet
    height_std, tilt_std : float [m, rad] of the plane there, one standard deviation
    """

    normal: NDArray
    place: NDArray
    height_std: float
    tilt_std: float

    def height(self, x: NDArray) -> NDArray:
        """(...) [m] of points x (..., 3) above it."""
        return np.asarray((x - self.place) @ self.normal)

    def T_level_world(self, up: str) -> NDArray:
        """(4, 4) from the world to one in which this floor is level, at zero: a turn about the origin, and a rise."""
        axis = np.array(UP_AXES[up])
        return se3.transform(se3.shortest_turn(self.normal, axis), (self.height(np.zeros(3))) * axis)


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of points of the body with the floor.

    Parameters
    ----------
    points : PointSet of P points
    places : (F, P, 3) [m] of the contacts, in the world
    weight : (F, P) [1/m²], 0 without contact
    floor : FloorPlane estimated from them; None for a known floor, or without contacts
    """

    points: PointSet
    places: NDArray
    weight: NDArray
    floor: FloorPlane | None = None

    def part(self, frames: slice) -> Contacts:
        """The contacts of some frames."""
        return replace(self, places=self.places[frames], weight=self.weight[frames])


def soles(body: Body) -> PointSet:
    """Landmarks of the soles: the lowest ones of the rest pose (y up)."""
    points = body.landmarks
    height = body.points_rest(points)[:, 1]
    low = np.flatnonzero(height < height.min(initial=np.inf) + _SOLE_HEIGHT)
    return points.select(tuple(points.names[i] for i in low))


def find_contacts(
    body: Body, roots: NDArray, angles: NDArray, rate: float, up: str, eye: NDArray | None = None, *,
    level: bool = True,
) -> Contacts:  # fmt: skip
    """Find contacts of the soles with one floor in a smoothed motion.

    Contacts have hysteresis: a point must be slow for a while to start one, and twice as fast to end it.

    The height of a level floor is estimated for each point, since its place on the sole is not known to the centimetre:
    the median over its slow frames near the lowest one. If the vertical is not measured, the floor is the plane through
    all contacts. One camera alone observes neither height nor depth speed: there a point is in contact if it hardly
    moves across its ray, and its place is where its ray meets the plane, unless the camera is tilted by far too much.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad]
    rate : float [Hz]
    up : vertical axis of the world
    eye : (3,) [m] centre of the camera, if it is the only sensor
    level : bool, `up` is measured, so that the floor is level
    """
    points, axis = soles(body), np.array(UP_AXES[up])
    x = body.trajectories(roots, angles, points)
    speed = _speeds(x, rate, eye)
    height = x @ axis
    places, weight = np.zeros(x.shape), np.zeros(x.shape[:2])
    rests: list[tuple[int, slice]] = []
    for p in range(len(points)):
        slow, near = speed[:, p] < _MAX_CONTACT_SPEED, np.ones(len(x), bool)
        if slow.sum() < _MIN_CONTACT_S * rate:
            continue
        ground = None
        if level and eye is None:
            lowest = np.quantile(height[slow, p], 0.1)
            ground = float(np.median(height[slow & (height[:, p] < lowest + _MAX_CONTACT_HEIGHT), p]))
            near = np.abs(height[:, p] - ground) < _MAX_CONTACT_HEIGHT
        gap = 1 if level else round(_MIN_SWING_S * rate)
        for start, stop in runs_of((speed[:, p] < _MIN_RELEASE_SPEED) & near, gap):
            run = slice(start, stop)
            if np.count_nonzero(slow[run]) < _MIN_CONTACT_S * rate:
                continue
            middle = np.median(x[run, p], axis=0)
            places[run, p] = middle if ground is None else middle + (ground - middle @ axis) * axis
            weight[run, p] = _CONTACT_STD**-2
            rests.append((p, run))
    if level or not rests:
        return Contacts(points, places, weight)
    middles, above = np.array([places[run.start, p] for p, run in rests]), _above_sole(body, points)
    floor = fit_floor(body, roots, angles, middles, above[[p for p, _ in rests]], up, eye)
    if eye is not None and np.arccos(np.clip(floor.normal @ axis, -1.0, 1.0)) > _MAX_CAMERA_TILT:
        return Contacts(points, places, weight, floor)
    for (p, run), middle in zip(rests, middles, strict=True):
        off = float(floor.height(middle)) - above[p]
        if abs(off) < (_MAX_CONTACT_HEIGHT if eye is None else _MAX_OFF_PLANE_M):
            along = floor.normal if eye is None else (middle - eye) / ((middle - eye) @ floor.normal)
            places[run, p] = middle - off * along
        elif eye is None:
            weight[run, p] = 0.0
    return Contacts(points, places, weight, floor)


def _above_sole(body: Body, points: PointSet) -> NDArray:
    """(P,) [m] of points of the soles above the lowest one when the body stands at rest."""
    height = body.points_rest(points)[:, 1]
    return np.asarray(height - height.min())


def fit_floor(
    body: Body, roots: NDArray, angles: NDArray, x_rest: NDArray, above: NDArray, up: str, eye: NDArray | None = None
) -> FloorPlane:
    """The plane on which soles rest; where they determine little of its tilt, it is level, or as the body stands.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad]
    x_rest : (N, 3) [m] where points of the soles rest, one for each time that one does.
    above : (N,) [m] that these points lie above the sole.
    up : about the vertical axis.
    eye : (3,) [m] of a camera that is the only sensor, and was taken to look level; else `up` is how the body stands.
    """
    R = se3.shortest_turn(np.array(UP_AXES[up]), np.array([0.0, 0.0, 1.0]))
    slope, sigma = np.zeros(2), _BODY_SIGMA
    if eye is not None:
        n = R @ upward(body.trajectories(roots, angles, body.landmarks), _above_sole(body, body.landmarks))
        share = _CAMERA_SIGMA**2 / (_CAMERA_SIGMA**2 + _BODY_SIGMA**2)
        slope, sigma = -share * n[:2] / max(n[2], 0.5 * float(np.linalg.norm(n))), _BODY_SIGMA * np.sqrt(share)
    x = x_rest @ R.T
    weight = np.full(len(x), 2.0 / len(soles(body)) / _STANCE_SIGMA_M**2)
    fit, covariance = fit_plane(x[:, :2], x[:, 2] - above, weight, slope=slope, slope_std=sigma)
    normal = np.append(-fit[:2], 1.0)
    std = np.sqrt(np.diag(covariance))
    return FloorPlane(
        R.T @ normal / np.linalg.norm(normal), R.T @ np.append(x[:, :2].mean(axis=0), fit[2]), float(std[2]),
        float(np.hypot(*std[:2])),
    )  # fmt: skip


def fit_plane(
    place: NDArray, height: NDArray, weight: NDArray, *, slope: NDArray | float = 0.0, slope_std: float = _BODY_SIGMA
) -> tuple[NDArray, NDArray]:
    """The plane through feet that stand: ridge regression, robust to feet in the air.

    Parameters
    ----------
    place, height : (N, 2), (N,) [m]
    weight : (N,) [1/m²]
    slope, slope_std : (2,) and float, what is known of the slope before.

    Returns
    -------
    (3,) slopes, and the height [m] at the mean place; (3, 3) their covariance
    """
    A = np.column_stack([place - place.mean(axis=0), np.ones(len(place))])
    prior, expected = np.diag([slope_std**-2, slope_std**-2, 1e-9]), np.append(np.broadcast_to(slope, 2), 0.0)
    robust, fit, H = np.ones(len(height)), np.zeros(3), prior
    for _ in range(20):
        w = robust * weight
        H = A.T @ (w[:, None] * A) + prior
        fit = np.linalg.solve(H, A.T @ (w * height) + prior @ expected)
        robust = 1.0 / np.square(1.0 + np.square((height - A @ fit) / (3.0 * _STANCE_SIGMA_M)))
    return fit, np.linalg.inv(H)


def upward(x: NDArray, rest_height: NDArray) -> NDArray:
    """(3,) mean direction in which a point of x (F, K, 3) lies higher the higher it is at rest (K,)."""
    known = np.isfinite(x).all(axis=-1)
    share = known / np.maximum(known.sum(axis=1, keepdims=True), 1)
    y = (rest_height - (share @ rest_height)[:, None]) * known
    direction = np.einsum("fk,fkd->fd", y, np.nan_to_num(x))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    out: NDArray = np.sum(direction / np.maximum(length, 1e-12), axis=0)
    return out


def _speeds(x: NDArray, rate: float, eye: NDArray | None) -> NDArray:
    """(F, P) [m/s] speed of points x (F, P, 3); across their rays if an eye (3,) is given."""
    if len(x) < 2:
        return np.full(x.shape[:2], np.inf)
    moved = np.gradient(x, axis=0)
    if eye is not None:
        ray = (x - eye) / np.linalg.norm(x - eye, axis=2, keepdims=True)
        moved = moved - np.sum(moved * ray, axis=2, keepdims=True) * ray
    return np.asarray(np.linalg.norm(moved, axis=2) * rate)
