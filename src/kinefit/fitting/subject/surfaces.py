"""Parameters of a body's surface: girths, shapes of cylinders, or the shape of an Anny body.

Fit limb lengths and girths to the first depth frames.

Measured points should lie on the nearest surface, and the body's contour on the person's contour in the image.
`fit_subject` finds poses of a few frames, lengths and girths jointly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.morphs.anny import AnnyFamily, AnnyModel
from kinefit.bodies.surfaces import Metaballs, Surface, TaperedCylinder
from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject.metaballs import MetaballShape
from kinefit.fitting.subject.parameters import Parameters, SegmentScales, World
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import PointCloud
from kinefit.sensors.base import Matched, Measurement, matched_by, rows_at
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import DepthView, outside, splat, view_of
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor, SurfacePairs
from kinefit.solving.rows import AnyRows

GIRTH_STD = 0.2
"""Between people, of the logarithm of a half axis. ANSUR II: 10 % in girths; a body of cylinders differs from a
person's by as much again."""

SURFACE_OFFSET_STD = 0.015
"""[m] between people, of a surface's place on its bone."""

_KINDS = ("start a", "start b", "end a", "end b", "start offset", "end offset")


@dataclass(frozen=True, eq=False)
class CylinderShape(Parameters):
    """Half axes (logarithms) and forward offsets [m] of tapered cylinders; left and right share them.

    Parameters
    ----------
    body : Body with cylinders
    girth, offset : standard deviation of the logarithm of a half axis, and of an offset [m]

    Raises
    ------
    BodyError
        The body has no cylinders.
    """

    body: Body
    girth: float = GIRTH_STD
    offset: float = SURFACE_OFFSET_STD

    def __post_init__(self) -> None:
        if not any(isinstance(s, TaperedCylinder) for s in self.body.surfaces):
            raise BodyError(f"body '{self.body.name}' has no cylinders", remedy="Give its segments a `surface`.")

    @cached_property
    def _groups(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Names of the groups of left and right cylinders, and the group of each surface (-1 for a mesh)."""
        names: dict[str, int] = {}
        count = [0] * len(self.body.tree.segments)
        groups = []
        for s in self.body.surfaces:
            own = self.body.tree.segments[s.segment].removesuffix("_r").removesuffix("_l")
            key = f"{own} {count[s.segment]}".removesuffix(" 0")
            count[s.segment] += 1
            groups.append(names.setdefault(key, len(names)) if isinstance(s, TaperedCylinder) else -1)
        return tuple(names), tuple(groups)

    @property
    def names(self) -> tuple[str, ...]:
        """(6 C,) names of the parameters of C groups of cylinders."""
        return tuple(f"{name} {kind}" for name in self._groups[0] for kind in _KINDS)

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """(6 C,) for each parameter the segments that it changes."""
        names, groups = self._groups
        on = [frozenset(s.segment for s, g in zip(self.body.surfaces, groups) if g == k) for k in range(len(names))]
        return tuple(segments for segments in on for _ in _KINDS)

    @property
    def information(self) -> NDArray:
        """(6 C, 6 C) prior information."""
        return np.diag(np.tile([self.girth] * 4 + [self.offset] * 2, len(self._groups[0])) ** -2.0)

    @property
    def step(self) -> NDArray:
        """(6 C,) steps of finite differences: of logarithms, and a tenth of that in metres."""
        return np.tile([1e-3] * 4 + [1e-4] * 2, len(self._groups[0]))

    def apply(self, world: World, values: NDArray) -> World:
        """The body with cylinders of these values (6 C,)."""
        sizes = np.asarray(values, float).reshape(-1, 6).tolist()
        surfaces = tuple(
            _shaped(s, tuple(sizes[g])) if isinstance(s, TaperedCylinder) else s
            for s, g in zip(world.body.surfaces, self._groups[1], strict=True)
        )
        return replace(world, body=replace(world.body, surfaces=surfaces))


@dataclass(frozen=True, eq=False)
class Girths(Parameters):
    """Logarithms of the girths of a body's cylinders along both half axes, one pair for each of its scale groups.

    Girths of one person are correlated: half of the variance is common to all of them. A few frames determine these
    parameters, but not the larger number of a `CylinderShape`.

    Parameters
    ----------
    body : Body with cylinders
    girth : standard deviation of each logarithm

    Raises
    ------
    BodyError
        The body has no cylinders.
    """

    body: Body
    girth: float = GIRTH_STD
    difference = 1e-3

    def __post_init__(self) -> None:
        if not self._groups:
            raise BodyError(f"body '{self.body.name}' has no cylinders", remedy="Give its segments a `surface`.")

    @cached_property
    def _groups(self) -> tuple[int, ...]:
        """Scale groups that have cylinders."""
        group = self.body.segment_scale
        return tuple(sorted({int(group[s.segment]) for s in self.body.surfaces if isinstance(s, TaperedCylinder)}))

    @property
    def names(self) -> tuple[str, ...]:
        """(2 G,) names."""
        return tuple(f"girth {self.body.scale_groups[g]} {axis}" for g in self._groups for axis in "ab")

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """(2 G,) for each parameter the segments that it changes."""
        on = [frozenset(np.flatnonzero(self.body.segment_scale == g).tolist()) for g in self._groups]
        return tuple(segments for segments in on for _ in "ab")

    @property
    def information(self) -> NDArray:
        """(2 G, 2 G) prior information."""
        return np.linalg.inv(self.girth**2 * (0.5 * np.eye(len(self.names)) + 0.5))

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these logarithms of girths (2 G,)."""
        size = np.zeros((len(self.body.scale_groups), 6))
        size[list(self._groups), :4] = np.tile(np.reshape(values, (-1, 2)), 2)
        sizes = [tuple(row) for row in size.tolist()]
        surfaces = tuple(
            _shaped(s, sizes[self.body.segment_scale[s.segment]]) if isinstance(s, TaperedCylinder) else s
            for s in world.body.surfaces
        )
        return replace(world, body=replace(world.body, surfaces=surfaces))


@lru_cache(maxsize=4096)  # of two worlds that differ in one parameter, most surfaces are the same
def _shaped(surface: TaperedCylinder, size: tuple[float, ...]) -> Surface:
    (a0, b0), (a1, b1) = (np.exp(np.reshape(size[:4], (2, 2))) * surface.radii).tolist()
    a = surface.axes[0]
    start, end = (np.add(at, shift * a) for at, shift in zip((surface.start, surface.end), size[4:]))
    return replace(
        surface, start=tuple(start.tolist()), end=tuple(end.tolist()), radii=((a0, b0), (a1, b1)),
        side=tuple(a.tolist()),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class AnnyShape(Parameters):
    """Sex, muscle, weight, height and proportions of an Anny body, as logits over 4 about a mean shape.

    By default it replaces the body by one of the model's, so it must be the first kind of parameters. `SegmentScales`
    after it add lengths beyond the shape's. With `flesh` it keeps bones and points, and changes the surface alone.

    Parameters
    ----------
    model : AnnyModel
    usual : (6,) shape parameters of the mean shape
    std : standard deviation of each parameter: about a quarter of its range
    flesh : whether bones and points stay
    """

    model: AnnyModel
    usual: NDArray
    std: float = 0.25
    flesh: bool = False
    difference = 1e-3

    @cached_property
    def _family(self) -> AnnyFamily:
        return AnnyFamily(self.model, np.asarray(self.usual, float))

    @cached_property
    def _made(self) -> Callable[[bytes], Body]:
        return lru_cache(maxsize=16)(lambda values: self._family.at(np.frombuffer(values)))

    def __getstate__(self) -> dict[str, Any]:
        """State without the cached bodies, which can be made again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_made", "_family")}

    @property
    def names(self) -> tuple[str, ...]:
        """(5,) names."""
        return tuple(f"anny {name}" for name in self._family.names)

    @property
    def information(self) -> NDArray:
        """(5, 5) prior information."""
        return np.eye(len(self.names)) / self.std**2

    def apply(self, world: World, values: NDArray) -> World:
        """The world with a body of this shape (5,)."""
        shaped, default = (self._made(np.asarray(v, float).tobytes()) for v in (values, self.mean))
        return replace(world, body=with_flesh(world.body, shaped, default) if self.flesh else shaped)


def shape_of(body: Body) -> list[Parameters]:
    """Parameters of a body's surface that a take with surfaces can fit: Anny's shape, girths, radii of metaballs.

    A mesh or another skin has none.
    """
    family = body.family
    if isinstance(family, AnnyFamily) and family.model.segments == body.tree.segments:
        return [AnnyShape(family.model, family.usual, flesh=True)]
    cylinders = any(isinstance(s, TaperedCylinder) for s in body.surfaces)
    out: list[Parameters] = [CylinderShape(body)] if cylinders and not body.skin else []
    return [*out, MetaballShape(body)] if any(isinstance(s, Metaballs) for s in body.surfaces) else out


def with_flesh(body: Body, other: Body, usual: Body) -> Body:
    """Transfer the skin of another body with the same segments, and scale the radii of cylinders accordingly.

    The skin of a segment is stretched with the segment, then moved with its joint. Bones and points do not change.

    Parameters
    ----------
    body, other : of the same segments and surfaces
    usual : body of the shape that `body` has now. The radii of `body` grow by the ratio of `other`'s to its radii.
    """
    fitted, before = (_scaled_to(b, body) for b in (other, usual))
    skin = fitted.skin
    if skin is not None:
        skin = replace(skin, nodes=skin.nodes + (body.tree.rest - fitted.tree.rest)[skin.owners])
    return replace(
        body,
        skin=skin,
        surfaces=tuple(_wider(*three) for three in zip(body.surfaces, fitted.surfaces, before.surfaces, strict=True)),
        family=other.family,
    )


def _scaled_to(source: Body, body: Body) -> Body:
    target_sizes, sizes = _sizes(body), _sizes(source)
    return source.scaled(np.where(sizes > 0.0, target_sizes / np.maximum(sizes, 1e-12), 1.0))


def _wider(surface: Surface, made: Surface, usual: Surface) -> Surface:
    if not all(isinstance(s, TaperedCylinder) for s in (surface, made, usual)):
        return surface
    radii = np.array(surface.radii) * made.radii / np.array(usual.radii)  # type: ignore[union-attr]
    (a0, b0), (a1, b1) = radii.tolist()
    return replace(surface, radii=((a0, b0), (a1, b1)))  # type: ignore[call-arg, arg-type]


def _sizes(body: Body) -> NDArray:
    """Size (G,) [m] of each scale group: the sum of its landmarks' distances from their joints."""
    points, group = body.landmarks, body.segment_scale[body.landmarks.segments]
    return np.bincount(group, np.linalg.norm(points.points, axis=1), len(body.scale_groups))


# Chosen on ten simulated people in three postures each, with pose errors of 5° and 3 cm; the figure `size_lengths` has
# four of them.
_START_LOG_STATURES = (-0.1, 0.0, 0.1)  # closest points slide along limbs, so lengths change slowly
_ROUNDS_PER_START = 5
_ROUNDS_OF_BEST = 12
_COARSE_ITERATIONS = 1, 2  # see `fit_subject`
_INDEPENDENT_SHARE = 0.3  # of a frame's errors: neighbours share folds of cloth and the model's form
_POSTURE_PRIOR_SHARE = 0.1  # with less, poses bend to fit wrong lengths (3 of ten people, 0.5 % worse)
_CONTOUR_SIGMA_RATIO = 2.5  # to a point's: with 0.6, 1, 1.6, 2.5 lengths err by 2.5, 2.0, 2.0, 1.8 %
_MAX_CONTOUR_COSINE = 0.5  # of normal and line of sight; elsewhere moving the surface along its normal does not help
_MAX_INSIDE_COSINE = 0.25  # the same inside the contour: a sample there is within 3 % of a radius of the body's own
_INSIDE_REACH_RATIO = 0.5  # reach inside the contour; 0, 0.5, 1, 1.7 explain 70, 74, 70, 71 % of a person (Kinect)


def fit_surfaces(
    body: Body,
    clouds: Sequence[ArrayLike],
    states: Sequence[BodyState],
    *,
    camera: Camera | None = None,
    views: Sequence[DepthView] = (),
    sigma: float = 0.01,
    points: int = 500,
    start: NDArray | None = None,
) -> SubjectFit:
    """Fit lengths and girths of a body to point clouds of the person, with poses known approximately.

    Parameters
    ----------
    body : Body with surfaces; without cylinders the lengths alone are fitted
    clouds : K x (N, 3) [m] points on the person, in the world
    states : K poses
    camera : Camera of the sensor, the same for all clouds: surfaces that face away from it get no points, and empty
        pixels around the person limit the girths
    views : K views of whole depth images, instead of a camera
    sigma : float [m], standard deviation of a point: noise, cloth
    points : int, number of points used of each cloud
    start : (p,) parameters to start from, of an earlier fit; default: three statures are tried

    Returns
    -------
    SubjectFit
        Its parameters are those of `SegmentScales` and `Girths`. Unobserved ones keep the prior's standard deviation.

    Raises
    ------
    ObservationError
        No clouds, other numbers of clouds than of states, or empty ones.
    BodyError
        The body has no surfaces.
    """
    if not len(clouds) or len(clouds) != len(states):
        raise ObservationError(f"{len(clouds)} clouds but {len(states)} states", remedy="Give one state a cloud.")
    given = [x[np.isfinite(x).all(axis=1)] for x in (np.asarray(c, float).reshape(-1, 3) for c in clouds)]
    if not all(map(len, given)):
        raise ObservationError("a cloud has no points", remedy="Leave out this frame.")
    if camera is not None and not views:
        views = [_view(x, camera) for x in given]
    settings = replace(TrackSettings(), points=points)
    sensor, rng, rig = PointCloudSensor("depth", sigma, settings), np.random.default_rng(0), Rig(())
    steps: list[list[Measurement]] = []
    for k, (x, state) in enumerate(zip(given, states)):
        eye = views[k].viewpoint if views else None
        frame = PointCloud("depth", 0.0, x[rng.permutation(len(x))[:points]], on_body=True, viewpoint=eye)
        steps.append([sensor.prepare(frame, Scene(body, state, rig)), *(_Contour(v, sensor) for v in views[k : k + 1])])
    parameters: list[Parameters] = [SegmentScales(body)]
    if any(isinstance(s, TaperedCylinder) for s in body.surfaces):
        parameters.append(Girths(body))
    groups = np.arange(sum(len(p.names) for p in parameters)) < len(body.scale_groups)

    def fitted(states: Sequence[BodyState], start: NDArray, rounds: int, reach: Sequence[float]) -> SubjectFit:
        return joint.fit_subject(
            body, rig, steps, states, parameters, start=start, reach=reach, rounds=rounds,
            looks=_INDEPENDENT_SHARE * len(steps), posture=_POSTURE_PRIOR_SHARE, coarse=_COARSE_ITERATIONS,
        )  # fmt: skip

    if start is not None:
        return fitted(states, start, _ROUNDS_PER_START, joint.REACH[-1:])
    tried = [fitted(states, size * groups, _ROUNDS_PER_START, joint.REACH) for size in _START_LOG_STATURES]
    best = min(tried, key=lambda found: _misfit(found, steps))
    return fitted(best.states, best.mean, _ROUNDS_OF_BEST, joint.REACH[-1:])


def _misfit(found: SubjectFit, steps: Sequence[Sequence[Measurement]]) -> float:
    """Weight of contour samples off their place, minus that of explained points; comparable between fits."""
    total, scale = 0.0, joint.REACH[-1]
    for state, measurements in zip(found.states, steps):
        scene = Scene(found.body, state, found.rig)
        for m in measurements:
            for rows in rows_at(matched_by(m, scene, joint.REACH[0]), scene):
                explained = 1.0 / (1.0 + np.square(rows.residual / scale))
                total += float(rows.weight @ (float(isinstance(m, _Contour)) - explained))
    return total


def _view(cloud: NDArray, camera: Camera) -> DepthView:
    depth, small = splat(cloud, camera)
    return view_of(depth, depth > 0, small)


class _Contour(Measurement):
    """The person's contour in a view: the body's occluding contour should lie on it.

    Without the pull from inside the contour, the body stays too small: points beyond it are too far to be matched.
    """

    settled = False

    def __init__(self, view: DepthView, of: PointCloudSensor) -> None:
        self.sensor, self.time, self._view, self._of = "contour", 0.0, view, of

    def match(self, scene: Scene, reach: float) -> Matched:
        """Match surface samples outside the person's contour, and little inside it, to it along their normals."""
        samples, f = scene.surface.samples, scene.frames[scene.surface.samples.segment]
        R = f[:, :9].reshape(-1, 3, 3)
        x = np.einsum("nij,jn->ni", R, samples.point) + f[:, 9:]
        n = np.einsum("nij,jn->ni", R, samples.normal)
        out, trust = outside(self._view, x)
        sight = x - self._view.viewpoint
        largest = np.where(out < 0.0, _MAX_INSIDE_COSINE, _MAX_CONTOUR_COSINE)
        is_contour = np.abs(np.einsum("ni,ni->n", n, sight)) < largest * np.linalg.norm(sight, axis=1)
        is_near = (out > -_INSIDE_REACH_RATIO * reach) & (out < 2.0 * reach)
        use = is_near & (trust > 0.0) & is_contour & ~scene.surface.fingers
        place, normal = (np.ascontiguousarray(a[:, use].T) for a in (samples.point, samples.normal))
        anchors = SurfaceAnchors(scene.body, samples.segment[use], place, normal)
        patches = float(scene.surface.areas.sum()) / (self._of.settings.patch**2 * len(samples))
        weight = trust[use] * min(patches, 1.0) / (_CONTOUR_SIGMA_RATIO * self._of.sigma) ** 2
        return _Receding(SurfacePairs(anchors, x[use] - out[use, None] * n[use], weight, reach, True))


@dataclass(frozen=True, eq=False)
class _Receding(Matched):
    """Surface samples near the person's contour, paired with places on it."""

    pairs: SurfacePairs
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row for each sample."""
        return [self.pairs.rows(scene)]
