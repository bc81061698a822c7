"""Point clouds on the body: matches of points and surfaces as rows, and clouds registered to the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.geometry.losses import SQUARED, geman_mcclure
from kinefit.observations import PointCloud
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor, by_segments, matched_by, rows_at
from kinefit.sensors.displaced import AXES, CLOCK, displacement
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import camera_at, splat, view_of
from kinefit.solving.correspondences import anchored_rows, free_space_rows, surface_rows, target_rows
from kinefit.solving.correspondences.contours.outlines import on_moved_joints
from kinefit.solving.correspondences.occupancy.free_space import FreeSpace, SurfaceSamples
from kinefit.solving.correspondences.surfaces import anchored
from kinefit.solving.rows import AnyRows, DofRows, Rows


@dataclass(frozen=True, eq=False)
class SurfacePairs:
    """N measured points with their corresponding points of the surface: point to plane (P2 2.3).

    Parameters
    ----------
    anchors : SurfaceAnchors
    x_world : (N, 3) [m] measured.
    weight : (N,) [1/m²]
    scale : float [m] of the loss (Geman-McClure): at this distance a pair has a quarter of its weight.
    at_surface : bool, see `anchored_rows`.
    camera : Camera that measured them, at the pose of `x_world`; they move with its pose in a scene's rig.
    """

    anchors: SurfaceAnchors
    x_world: NDArray
    weight: NDArray
    scale: float
    at_surface: bool
    camera: Camera | None = None

    @classmethod
    def nearest(
        cls, rows: Rows, x_world: NDArray, scene: Scene, scale: float, factor: float = 1.0,
        camera: Camera | None = None,
    ) -> SurfacePairs:  # fmt: skip
        """Pairs of measured points (M, 3) [m] and nearest points, from `surface_rows` at the scene's state.

        `scale` [m] is of the loss; `factor` multiplies the weights.
        """
        x, rest, normal = anchored(rows, x_world, scene.frames)
        anchors = SurfaceAnchors(scene.body, rows.segment, rest, normal)
        return cls(anchors, x, factor * rows.weight, scale, True, camera)

    @classmethod
    def seen(
        cls, rows: Rows, samples: SurfaceSamples, scene: Scene, scale: float, camera: Camera
    ) -> SurfacePairs:
        """Pairs of visible samples and their pixels' points, (M, 3) [m], from `depth_image_rows` at its state."""
        rest, normal = samples.point[:, rows.group].T, samples.normal[:, rows.group].T
        anchors = SurfaceAnchors(scene.body, rows.segment, np.ascontiguousarray(rest), np.ascontiguousarray(normal))
        return cls(anchors, np.ascontiguousarray(rows.point), rows.weight.copy(), scale, False, camera)

    def on_segments(self, scene: Scene) -> Rows:
        """The rows, ignoring joint centres that move with angles."""
        points, normals = self.anchors.on(scene.body)
        measured = self.x_world if self.camera is None else along(self.x_world, self.camera, scene)
        made = anchored_rows(
            scene.frames, self.anchors.segment, points, normals, measured, weight=self.weight,
            at_surface=self.at_surface,
        )  # fmt: skip
        return replace(made, loss=geman_mcclure(self.scale * np.sqrt(self.weight)))

    def rows(self, scene: Scene) -> Rows | DofRows:
        """One row a pair at a scene's state."""
        return _on_joints(scene, self.on_segments(scene))


@dataclass(frozen=True, eq=False)
class FreePairs:
    """Samples of the surface in free space, each with its target in the image.

    Parameters
    ----------
    anchors : SurfaceAnchors, N
    camera : Camera
    target : (N, 2) [px]
    slack, sigma : float [px] half a cell of free space; standard deviation
    """

    anchors: SurfaceAnchors
    camera: Camera
    target: NDArray
    slack: float
    sigma: float

    @classmethod
    def found(
        cls, scene: Scene, samples: SurfaceSamples, space: FreeSpace, camera: Camera, *, tolerance: float, sigma: float,
        seen: NDArray,
    ) -> FreePairs:  # fmt: skip
        """Find them with `free_space_rows` at a scene's state, without fingers that are folded.

        A hand counts as folded if more of its samples are in free space than in `seen`.

        Parameters
        ----------
        tolerance : float [m], sigma : float [px]
        seen : (M,) int, samples with a measurement at their pixels
        """
        chosen = np.empty(len(samples), np.int64)
        made = free_space_rows(
            scene.frames, samples, space, camera, tolerance=tolerance, sigma=sigma, chosen=chosen
        )
        hand = np.where(scene.surface.fingers, 1 + samples.segment, 0)
        air, there = (np.bincount(hand[some], minlength=1 + hand.max(initial=0)) for some in (made.group, seen))
        folded = air > there
        folded[0] = False
        own = made.group[~folded[hand[made.group]]]
        rest, normal = (np.ascontiguousarray(a[:, own].T) for a in (samples.point, samples.normal))
        anchors = SurfaceAnchors(scene.body, samples.segment[own], rest, normal)
        return cls(anchors, camera, space.middle(chosen[own]), 0.5 * space.cell, sigma)

    def rows(self, scene: Scene) -> Rows | DofRows:
        """One row a sample at a scene's state."""
        points, _ = self.anchors.on(scene.body)
        made = target_rows(
            scene.frames, self.anchors.segment, points, scene.placed(self.camera), self.target, slack=self.slack,
            sigma=self.sigma,
        )  # fmt: skip
        return _on_joints(scene, replace(made, loss=SQUARED))


def along(x_world: NDArray, camera: Camera, scene: Scene) -> NDArray:
    """(N, 3) [m] points that a camera measured, moved with its pose to the one in a scene's rig."""
    there = scene.placed(camera)
    if there is camera:
        return x_world
    T = there.T_world_camera @ camera.T_camera_world
    return np.ascontiguousarray(x_world @ T[:3, :3].T + T[:3, 3])


def _on_joints(scene: Scene, rows: Rows) -> Rows | DofRows:
    """Rows with the derivatives of joint centres that move with angles, if any do."""
    return rows if scene.morphing is None else on_moved_joints(scene.morphing.pose(scene.state), rows)


_HASH_PRIMES = np.array((73856093, 19349663, 83492791))  # of a spatial hash (Teschner et al., VMV 2003)


class PointCloudSensor(Sensor):
    """A scanner of points on any surface, on the body, or on one of its segments (P2 2.3).

    Parameters
    ----------
    name : as its frames are named
    sigma : float [m] standard deviation of a point.
    settings : TrackSettings
    camera : Camera, if the scanner is one of the rig's: its points move with the camera's pose.
    """

    shows_person = True

    def __init__(self, name: str, sigma: float, settings: TrackSettings, camera: Camera | None = None) -> None:
        self.name, self.sigma, self.settings, self.camera = name, sigma, settings, camera

    def prepare(self, frame: PointCloud, scene: Scene) -> PointCloudMeasurement:
        """The measurement of one cloud: its points near the body.

        Raises
        ------
        BodyError
            A segment that the body does not have; a body without surfaces.
        """
        return PointCloudMeasurement(self, frame, scene)


class PointCloudMeasurement(Measurement):
    """Points of one time.

    Parameters
    ----------
    of : PointCloudSensor
    frame : PointCloud
    scene : Scene with the body at its prediction: points of unknown origin count only near it.

    Attributes
    ----------
    points : (N, 3) [m]
    """

    settled = False

    def __init__(self, of: PointCloudSensor, frame: PointCloud, scene: Scene) -> None:
        s = of.settings
        self.sensor, self.time, self.sigma, self._eye = of.name, frame.time, of.sigma, frame.viewpoint
        self.of = of
        self._segment = None if frame.segment is None else np.int64(scene.body.tree.segment(frame.segment))
        self._certain = frame.on_body or frame.segment is not None
        x, vertices = frame.points, scene.surface.posed(scene.state)
        if not self._certain:
            low, high = vertices.min(axis=0) - s.reach, vertices.max(axis=0) + s.reach
            x = x[((x > low) & (x < high)).all(axis=1)]
        self.points = np.array(x[:: max(len(x) // s.points, 1)], float)
        cells = np.floor(np.clip(self.points, -1e6, 1e6) / s.patch).astype(np.int64)
        patches = len(np.unique(cells @ _HASH_PRIMES))
        self._point_sigma = of.sigma * np.sqrt(max(len(self.points) / max(patches, 1), 1.0))

    @property
    def _camera(self) -> Camera | None:
        return self.of.camera

    def match(self, scene: Scene, reach: float) -> PointCloudMatched:
        """Match points to the nearest surface within `reach` [m]; twice as far if they are known to be the body's."""
        bound = max(2.0 * reach if self._certain else reach, AGREEMENT_SIGMAS * self.sigma)
        points, _ = self._seen(scene)
        camera = None if self._camera is None else scene.placed(self._camera)
        near = self._near(scene, bound)
        return PointCloudMatched(self, SurfacePairs.nearest(near, points, scene, bound / 2.0, camera=camera))

    def _seen(self, scene: Scene) -> tuple[NDArray, NDArray | None]:
        """(N, 3) [m] its points and (3,) [m] its viewpoint, with the scanner's pose in the scene's rig."""
        if self._camera is None:
            return self.points, self._eye
        eye = None if self._eye is None else along(self._eye[None], self._camera, scene)[0]
        return along(self.points, self._camera, scene), eye

    def _near(self, scene: Scene, reach: float) -> Rows:
        points, eye = self._seen(scene)
        return surface_rows(
            scene.body, scene.state, points, max_distance=reach, sigma=self._point_sigma, viewpoint=eye,
            segment=self._segment, frames=scene.frames,
        )  # fmt: skip

    def evidence(self, scene: Scene) -> Evidence:
        """Support of each segment: points near it over the number expected from its share of the surface, at most 1."""
        rows, areas = self._near(scene, AGREEMENT_SIGMAS * self.sigma), scene.surface.areas
        count, none = len(self.points), np.zeros(len(areas))
        if self._segment is not None:
            share, out = len(rows) / max(count, 1), Evidence(none, none.copy())
            out.agreeing[self._segment], out.contrary[self._segment] = share, (1.0 - share) * bool(count)
            return out
        expected = np.maximum(count * areas / max(areas.sum(), 1e-12), 1.0)
        return Evidence(np.minimum(np.bincount(rows.segment, minlength=len(none)) / expected, 1.0), none)

    def hints(self, scene: Scene) -> Hints:
        """A view of the points from the sensor."""
        if not len(self.points):
            return Hints()
        coarse, small = splat(self.points, camera_at(self.points, self._eye))
        return Hints(view=view_of(coarse, coarse > 0, small) if (coarse > 0).any() else None)


@dataclass(frozen=True, eq=False)
class PointCloudMatched(Matched):
    """A cloud with its correspondences.

    Parameters
    ----------
    measurement : PointCloudMeasurement
    pairs : SurfacePairs of points and the nearest ones of the surface
    """

    measurement: PointCloudMeasurement
    pairs: SurfacePairs
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a point."""
        return [self.pairs.rows(scene)]

    def evidence(self, scene: Scene) -> Evidence:
        """Support of each segment: points near it over the number expected from its share of the surface, at most 1."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [m] of the points from the surface, by segments."""
        rows = self.pairs.on_segments(scene)
        return [by_segments(self.sensor, scene.body, rows.residual, rows.segment, "m")]


MIN_COST_GAP_SIGMAS = 3.0
"""Standard errors, over the frames, by which the cost of one pose must exceed that of another."""

TRUNCATION_DISTANCE = 0.1
"""[m] above which the squared distance of a point is truncated."""

COARSE_DISTANCES = (0.3, 0.3, 0.2, 0.2, 0.15, 0.1)
"""[m] correspondence distance of each round, from all starts."""

FINE_DISTANCES = (0.1, 0.08, 0.06, 0.05)
"""[m] correspondence distance of each round, from the best of them."""

_SURFACE_SIGMA = 0.03  # [m] of a point from a surface of simple shapes
_INDEPENDENT_SHARE = 0.02  # of the points: neighbours err alike
_TRIED_HEIGHTS = np.linspace(-0.06, 0.06, 9)  # [m]
_HEIGHT_TRUNCATION = 0.05  # [m] in place of `TRUNCATION_DISTANCE` while heights are tried


@dataclass(frozen=True, eq=False)
class Registration:
    """Measurements of one sensor in frames with known poses.

    Parameters
    ----------
    sensor : name
    steps : F lists of its `Displaced` measurements about `centre`, one for each frame.
    scenes : F scenes, at the known poses.
    centre : (3,) [m] about which its frame turns.
    information : (6, 6) of the prior of shift and turn.
    """

    sensor: str
    steps: Sequence[Sequence[Measurement]]
    scenes: Sequence[Scene]
    centre: NDArray
    information: NDArray

    def rows(self, twist: NDArray, reach: float) -> list[list[Rows]]:
        """Rows of each frame with the sensor at a twist (7,), measured points first; `reach` [m] as of `match`."""
        values = {self.sensor: values_of(twist)}
        out = []
        for several, scene in zip(self.steps, self.scenes):
            there = scene.at(scene.state, values=values)
            each = [rows_at(matched_by(m, there, reach), there) for m in several if m.sensor == self.sensor]
            out.append([r for rows in each for r in rows if isinstance(r, Rows)])
        return out

    def costs(self, twist: NDArray, near: float = TRUNCATION_DISTANCE) -> NDArray:
        """(F,) [m²] sums of squared distances truncated at `near` [m], minus their value if all were truncated."""
        squares = [np.square(rows[0].residual) if rows else np.zeros(0) for rows in self.rows(twist, near)]
        return np.array([np.sum(np.minimum(r, near**2) - near**2) for r in squares])

    def above(self, twist: NDArray, other: NDArray) -> bool:
        """Whether the cost at a twist (7,) is significantly above that at another (7,)."""
        return clearly_above(self.costs(twist), self.costs(other))

    def settled(self, twist: NDArray, reach: Sequence[float]) -> NDArray:
        """(7,) local minimum from a start (7,), a round for each correspondence distance [m]; the clock is fixed."""
        shift, R, clock = twist[:3], se3.exp_so3(twist[3:6]), twist[6:]
        for end in reach:
            now = np.concatenate([shift, se3.log_so3(R)])
            H, g = self.information.copy(), self.information @ now
            for rows in (r for several in self.rows(np.append(now, clock), end) for r in several):
                point, way = rows.data[:3].T - (self.centre + shift), rows.data[3:6].T
                A = np.hstack([way, np.cross(point, way)])
                inside = np.clip(1.0 - np.square(rows.residual / end), 0.0, None)
                weight = _INDEPENDENT_SHARE / _SURFACE_SIGMA**2 * np.square(inside)
                H += (weight[:, None] * A).T @ A
                g += A.T @ (weight * rows.residual)
            step = np.linalg.solve(H, g)
            shift, R = shift - step[:3], se3.exp_so3(-step[3:]) @ R
        return np.concatenate([shift, se3.log_so3(R), clock])

    def height(self, twist: NDArray, up: NDArray) -> NDArray:
        """(7,) a twist (7,) raised along `up` (3,) to the height of lowest cost.

        Correspondences slide along a standing person: a round of closest points reduces the error of the height by 3 %
        only. So heights are tried, and a parabola through the costs gives the best one.
        """
        way = np.append(up, np.zeros(4))
        cost = np.array([self.costs(twist + raised * way, _HEIGHT_TRUNCATION).sum() for raised in _TRIED_HEIGHTS])
        least = int(np.clip(np.argmin(cost), 2, len(_TRIED_HEIGHTS) - 3))
        a, b, _ = np.polyfit(_TRIED_HEIGHTS[least - 2 : least + 3], cost[least - 2 : least + 3], 2)
        best = -0.5 * b / a if a > 0.0 else _TRIED_HEIGHTS[least]
        return twist + float(np.clip(best, _TRIED_HEIGHTS[0], _TRIED_HEIGHTS[-1])) * way


@dataclass(frozen=True, eq=False)
class Ends:
    """Local minima of several starts.

    Parameters
    ----------
    registration : Registration
    twists : of (7,)
    """

    registration: Registration
    twists: tuple[NDArray, ...]

    @cached_property
    def best(self) -> NDArray:
        """(7,) the twist of lowest cost."""
        return min(self.twists, key=lambda twist: float(self.registration.costs(twist).sum()))

    @property
    def rivals(self) -> tuple[NDArray, ...]:
        """Differences (7,) from the best minimum to each other that is not significantly worse."""
        return tuple(apart(t, self.best) for t in self.twists if not self.registration.above(t, self.best))


def clearly_above(costs: NDArray, others: NDArray) -> bool:
    """Whether costs (F,) of one pose are significantly above those of another (F,); see `MIN_COST_GAP_SIGMAS`."""
    more = costs - others
    return bool(more.mean() > MIN_COST_GAP_SIGMAS * more.std(ddof=1) / np.sqrt(len(more)))


def starts(origin: NDArray, centre: NDArray, std: tuple[float, float]) -> list[NDArray]:
    """Start twists (7,): zero, turns about the origin and shifts towards the centre by one and two sigmas.

    Parameters
    ----------
    origin, centre : (3,) [m] of the sensor's frame, and of its points.
    std : [m], [rad] standard deviations of the origin's shift, and of the turn.
    """
    way = centre - origin
    length = float(np.linalg.norm(way))
    axes = np.linalg.svd(way[None])[2][1:]  # across
    out = [np.zeros(7)]
    for size in (1.0, -1.0, 2.0, -2.0):
        for axis in axes:
            turn = size * std[1] * axis
            out.append(np.concatenate([se3.exp_so3(turn) @ way - way, turn, [0.0]]))
        out.append(np.concatenate([size * std[0] * way / max(length, 1e-9), np.zeros(4)]))
    return out


def values_of(twist: NDArray) -> dict[str, float]:
    """{name: value} [m, rad, s] of a sensor in a scene, from a twist (7,)."""
    return dict(zip((*AXES, CLOCK), np.asarray(twist, float).tolist()))


def apart(twist: NDArray, other: NDArray) -> NDArray:
    """(7,) shift of the centre, turn and clock offset from another twist (7,) to one (7,)."""
    at = lambda t: displacement(values_of(t), np.zeros(3))[:3, :3]
    return np.concatenate([twist[:3] - other[:3], se3.log_so3(at(twist) @ at(other).T), twist[6:] - other[6:]])


def twist_of(values: Mapping[str, float]) -> NDArray:
    """(7,) twist [m, rad, s] of a scene's values of a sensor; inverse of `values_of`."""
    return np.array([values[what] for what in (*AXES, CLOCK)])
