"""Body: a kinematic tree with named points, scale groups and surfaces; frozen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import _kernels
from kinefit.bodies.morphs.operators import Operator
from kinefit.bodies.surfaces import SkinnedMesh, Surface, TaperedCylinder
from kinefit.bodies.surfaces.tables import SurfaceTables, tables
from kinefit.bodies.tree import FIXED, ROOT_DOFS, BodyState, Closure, Dimension, KinematicTree
from kinefit.errors import BodyError, check_choice
from kinefit.geometry import se3

_MIN_LIMB_LENGTH = 0.05  # [m] of segments with a detector's full error; on shorter ones, such as fingers, it is smaller


@dataclass(frozen=True, eq=False)
class PointSet:
    """Named points on segments: landmarks, a detector's keypoints, a marker set.

    Parameters
    ----------
    names : (K,)
    segments : (K,) int, index of each point's segment.
    points : (K, 3) [m] in the segment's frame.

    Raises
    ------
    BodyError
        Arrays of other shapes, or not numeric.
    """

    names: tuple[str, ...]
    segments: NDArray
    points: NDArray

    def __post_init__(self) -> None:
        try:
            segments, points = np.array(self.segments, np.int64), np.array(self.points, float).reshape(-1, 3)
            fits = len(self.names) == len(points) and segments.shape == (len(points),)
        except (TypeError, ValueError, OverflowError):
            fits = False
        if not fits:
            problem = "names, segments and points of a point set differ in number"
            raise BodyError(problem, remedy="Give K names, (K,) indices of segments and (K, 3) positions [m].")
        segments.flags.writeable = points.flags.writeable = False
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Index of a point by name.

        Raises
        ------
        BodyError
            No such point.
        """
        check_choice("point", name, self.names, BodyError)
        return self.names.index(name)

    def scaled(self, factors: NDArray) -> PointSet:
        """The points of segments that are scaled by factors (S,)."""
        return PointSet(self.names, self.segments, self.points * factors[self.segments][:, None])

    def select(self, names: tuple[str, ...]) -> PointSet:
        """The named points, in that order; a BodyError is raised for an unknown name."""
        places = dict(zip(reversed(self.names), range(len(self) - 1, -1, -1)))
        rows = [places[name] if name in places else self.index(name) for name in names]
        return PointSet(tuple(names), self.segments[rows], self.points[rows])


class BodyFamily(Protocol):
    """A family of bodies with shape parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names (P,) of the shape parameters."""
        ...

    @property
    def std(self) -> NDArray:
        """Standard deviations (P,) of the parameters in the population; their mean is zero."""
        ...

    @property
    def shape(self) -> dict[str, float]:
        """The shape at zero, {name: number} in the family's original parameters."""
        ...

    def at(self, values: NDArray) -> Body:
        """The body with shape parameters (P,) [standard units]; its own family has that shape at zero."""
        ...


@dataclass(frozen=True, eq=False)
class Body:
    """A kinematic tree with named points, scale groups and surfaces.

    Parameters
    ----------
    name : str
    tree : KinematicTree
    joints : (S,) name of the joint between each segment and its parent.
    scale_groups : (G,) names of the groups that are scaled together; left and right limbs share one.
    segment_scale : (S,) int, scale group of each segment.
    landmarks : PointSet
    keypoint_sets, marker_sets : name -> PointSet
    surfaces : tapered elliptical cylinders and meshes; a segment may have several, or none.
    aliases : convention ("opensim", "bvh", "hanim") -> segment name -> name in that convention.
    stature : float [m], height when standing.
    mass : float [kg] of the person, or machine; 0 if unknown, see `masses.segment_masses`.
    morphs : shape changes that depend on the angles; `Morphing` applies them.
    skin : SkinnedMesh, a surface over all segments; depth sensors and rendering use `surfaces`.
    family : BodyFamily that this body belongs to; files do not store it.
    closures : constraints that close chains of the tree, see `closures`.
    dimensions : lengths and angles of gear that closures depend on.
    """

    name: str
    tree: KinematicTree
    joints: tuple[str, ...]
    scale_groups: tuple[str, ...]
    segment_scale: NDArray
    landmarks: PointSet
    keypoint_sets: Mapping[str, PointSet] = field(default_factory=dict)
    marker_sets: Mapping[str, PointSet] = field(default_factory=dict)
    surfaces: tuple[Surface, ...] = ()
    aliases: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    stature: float = 0.0
    mass: float = 0.0
    morphs: tuple[Operator, ...] = ()
    skin: SkinnedMesh | None = None
    family: BodyFamily | None = None
    closures: tuple[Closure, ...] = ()
    dimensions: tuple[Dimension, ...] = ()

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names (6 + D,) of all degrees of freedom."""
        return ROOT_DOFS + self.tree.coordinates

    def default_state(self, T_world_root: NDArray | None = None) -> BodyState:
        """State in the default posture, from which fits start; T_world_root (4, 4) [m], default the identity."""
        return BodyState(np.eye(4) if T_world_root is None else T_world_root, self.tree.usual)

    usual_state = default_state  # the name in version 0.2

    def rest_state(self, T_world_root: NDArray | None = None) -> BodyState:
        """State with all angles zero, or at the nearest limit; T_world_root (4, 4) [m], default the identity."""
        angles = np.clip(np.zeros(len(self.tree.coordinates)), self.tree.lower, self.tree.upper)
        return BodyState(np.eye(4) if T_world_root is None else T_world_root, angles)

    def keypoints(self, name: str) -> PointSet:
        """The points of a detector's keypoint set.

        Raises
        ------
        BodyError
            No such set.
        """
        check_choice(f"keypoint set of body '{self.name}' named", name, self.keypoint_sets, BodyError)
        return self.keypoint_sets[name]

    def markers(self, name: str) -> PointSet:
        """The points of a marker set.

        Raises
        ------
        BodyError
            No such set.
        """
        check_choice(f"marker set of body '{self.name}' named", name, self.marker_sets, BodyError)
        return self.marker_sets[name]

    def alias(self, convention: str, segment: str) -> str:
        """Name of a segment in another convention; its own name if that has none."""
        return self.aliases.get(convention, {}).get(segment, segment)

    def points_rest(self, points: PointSet) -> NDArray:
        """Points (K, 3) [m] in the root frame at rest, the input of kernels."""
        return points.points + self.tree.rest[points.segments]

    def positions(self, state: BodyState, points: PointSet) -> NDArray:
        """Points (K, 3) [m] in the world at a state."""
        frames, _ = self.tree.forward(state.T_world_root, state.angles)
        out = np.empty((len(points), 3))
        _kernels.place(frames, points.segments, self.points_rest(points), out)
        return out

    def trajectories(self, Ts_world_root: NDArray, angles: NDArray, points: PointSet) -> NDArray:
        """Points (F, K, 3) [m] in the world over time, for roots (F, 4, 4) [m] and angles (F, D) [rad, m]."""
        Ts = self.tree.segment_poses(Ts_world_root, angles)
        return se3.apply(Ts[:, points.segments], points.points)

    def without_limits(self) -> Body:
        """The body with joints that move without limits."""
        limit = np.full(len(self.tree.coordinates), np.inf)
        return replace(self, tree=replace(self.tree, lower=-limit, upper=limit))

    def scaled(self, scales: NDArray) -> Body:
        """Scale the body: one factor (G,) for every scale group; gear keeps its size. Joints and points move along.

        Raises
        ------
        BodyError
            Another number of factors, or one that is not positive and finite.
        """
        factors = np.asarray(scales, float)
        if factors.shape != (len(self.scale_groups),) or not np.all(np.isfinite(factors)) or np.any(factors <= 0):
            raise BodyError(
                f"scales must be {len(self.scale_groups)} positive numbers, got {factors}",
                remedy=f"One for each of: {', '.join(self.scale_groups)}.",
            )
        per_segment = np.where(self.gear_scale, 1.0, factors)[self.segment_scale]
        old, parents = self.tree, np.maximum(self.tree.parents, 0)
        tree = old.with_offsets(old.offsets * per_segment[parents][:, None])
        stretched = replace(
            self.with_points(lambda points: points.scaled(per_segment)),
            tree=tree,
            surfaces=tuple(surface.scaled(float(per_segment[surface.segment])) for surface in self.surfaces),
            morphs=tuple(morph.stretched(old, tree, per_segment) for morph in self.morphs),
            skin=self.skin and self.skin.stretched(old.rest, tree.rest, per_segment),
        )
        return replace(stretched, stature=self.stature * stretched._extent() / max(self._extent(), 1e-9))

    @property
    def gear_scale(self) -> NDArray:
        """Whether each scale group (G,) is that of gear, which is not scaled with the person; bool."""
        return np.array([name == FIXED for name in self.scale_groups], bool)

    def _extent(self) -> float:
        """Distance [m] from the lowest to the highest landmark or joint at rest."""
        heights = np.concatenate([self.points_rest(self.landmarks)[:, 1], self.tree.rest[:, 1]])
        return float(np.ptp(heights)) if len(heights) else 0.0

    def with_points(self, change: Callable[[PointSet], PointSet]) -> Body:
        """The body with a change of its landmarks, and of each of its sets of keypoints and markers."""
        return replace(
            self,
            landmarks=change(self.landmarks),
            keypoint_sets={name: change(points) for name, points in self.keypoint_sets.items()},
            marker_sets={name: change(points) for name, points in self.marker_sets.items()},
        )

    def with_keypoints(self, name: str, points: NDArray) -> Body:
        """Replace the points of one keypoint set by (K, 3) [m] in the segments' frames, such as estimated offsets."""
        old = self.keypoints(name)
        return replace(self, keypoint_sets={**self.keypoint_sets, name: PointSet(old.names, old.segments, points)})

    @cached_property
    def offset_shares(self) -> NDArray:
        """Detector error on each segment (S,), as a share 0..1 of that on long segments."""
        tree, x = self.tree, self.landmarks
        reach = np.zeros(len(tree.segments))
        np.maximum.at(reach, x.segments, np.linalg.norm(x.points, axis=1))
        np.maximum.at(reach, tree.parents[1:], np.linalg.norm(tree.offsets[1:], axis=1))
        return np.where(reach > 0.0, np.minimum(reach / _MIN_LIMB_LENGTH, 1.0), 1.0)

    @cached_property
    def surface_tables(self) -> SurfaceTables:
        """All surfaces, packed once for the kernels that search them."""
        return tables(self.surfaces, self.tree.rest)

    def segment_ends(self) -> dict[int, NDArray]:
        """Far end (3,) [m] of each segment with a surface, in its frame, from its first surface in the file."""
        ends: dict[int, NDArray] = {}
        for surface in reversed(self.surfaces):
            if isinstance(surface, TaperedCylinder):
                ends[surface.segment] = np.array(surface.end)
            else:
                ends[surface.segment] = surface.vertices[np.argmax(np.linalg.norm(surface.vertices, axis=1))]
        return ends

    def segment_lengths(self) -> dict[str, float]:
        """Bone lengths {"parent-child": [m]}: distance from the joint of each segment to that of its parent."""
        out: dict[str, float] = {}
        for child, parent in enumerate(self.tree.parents):
            if parent >= 0:
                name = f"{self.tree.segments[parent]}-{self.tree.segments[child]}"
                out[name] = float(np.linalg.norm(self.tree.offsets[child]))
        return out
