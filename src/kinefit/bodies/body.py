"""Body: a kinematic tree with named points, scale groups and surfaces; frozen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import _kernels
from kinefit.bodies.closures import FIXED, Closure, Dimension
from kinefit.bodies.morphs.operators import Operator
from kinefit.bodies.state import BodyState
from kinefit.bodies.surfaces import SkinnedMesh, Surface, TaperedCylinder
from kinefit.bodies.surfaces.tables import SurfaceTables, tables
from kinefit.bodies.tree import ROOT_DOFS, KinematicTree
from kinefit.errors import BodyError, choices
from kinefit.geometry import se3

_LONG = 0.05  # [m] from a joint to the next, from where on detectors err as they do on limbs; fingers are shorter


@dataclass(frozen=True, eq=False)
class PointSet:
    """Named points tied to segments: landmarks, a detector's keypoints, a marker set.

    Parameters
    ----------
    names : (K,)
    segments : (K,) int, index of each point's segment.
    points : (K, 3) [m] in the segment's frame.

    Raises
    ------
    BodyError
        Arrays of other shapes, or no numbers.
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
            problem = "names, segments and points of a point set do not belong together"
            raise BodyError(problem, remedy="Give K names, (K,) indices of segments and (K, 3) places [m].")
        segments.flags.writeable = points.flags.writeable = False
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Position of a point by name."""
        if name not in self.names:
            raise BodyError(choices("point", name, self.names))
        return self.names.index(name)

    def select(self, names: tuple[str, ...]) -> PointSet:
        """The named points, in that order."""
        places = dict(zip(reversed(self.names), range(len(self) - 1, -1, -1)))
        rows = [places[name] if name in places else self.index(name) for name in names]
        return PointSet(tuple(names), self.segments[rows], self.points[rows])


class BodyFamily(Protocol):
    """Bodies of one make and many shapes."""

    @property
    def names(self) -> tuple[str, ...]:
        """(P,) shape parameters."""
        ...

    @property
    def std(self) -> NDArray:
        """(P,) standard deviation of each between people; their mean is zero."""
        ...

    @property
    def shape(self) -> dict[str, float]:
        """The shape at zero, as its maker's parameters have it."""
        ...

    def at(self, values: NDArray) -> Body:
        """The body with parameters (P,), whose family has that shape at zero."""
        ...


@dataclass(frozen=True, eq=False)
class Body:
    """What is tracked.

    Parameters
    ----------
    name : str
    tree : KinematicTree
    joints : (S,) name of the joint that ties each segment to its parent.
    scale_groups : (G,) names of the lengths that can be scaled; left and right limbs share one.
    segment_scale : (S,) int, scale group of each segment.
    landmarks : PointSet
    keypoint_sets, marker_sets : name -> PointSet
    surfaces : tapered elliptical cylinders and meshes; a segment may have several, or none.
    aliases : convention ("opensim", "bvh", "hanim") -> segment name -> name there.
    stature : float [m] of the body as it stands.
    morphs : what changes with its angles; `Morphing` lets them act.
    skin : SkinnedMesh, a surface over all segments; depth and drawings go by `surfaces`.
    family : BodyFamily, bodies of other shapes of which this is one; files do not keep it.
    closures : what closes chains of the tree, see `closures`.
    dimensions : lengths and angles of gear that closures need.
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
    morphs: tuple[Operator, ...] = ()
    skin: SkinnedMesh | None = None
    family: BodyFamily | None = None
    closures: tuple[Closure, ...] = ()
    dimensions: tuple[Dimension, ...] = ()

    @property
    def dof_names(self) -> tuple[str, ...]:
        """(6 + D,) names of all degrees of freedom."""
        return ROOT_DOFS + self.tree.coordinates

    def usual_state(self, T_world_root: NDArray | None = None) -> BodyState:
        """A common posture: where a fit with no pose given starts."""
        return BodyState(np.eye(4) if T_world_root is None else T_world_root, self.tree.usual)

    def rest_state(self, T_world_root: NDArray | None = None) -> BodyState:
        """All angles zero, or the nearest value within the limits."""
        angles = np.clip(np.zeros(len(self.tree.coordinates)), self.tree.lower, self.tree.upper)
        return BodyState(np.eye(4) if T_world_root is None else T_world_root, angles)

    def keypoints(self, name: str) -> PointSet:
        """The points of a detector's keypoint set."""
        if name not in self.keypoint_sets:
            raise BodyError(choices(f"keypoint set of body '{self.name}' named", name, self.keypoint_sets))
        return self.keypoint_sets[name]

    def markers(self, name: str) -> PointSet:
        """The points of a marker set."""
        if name not in self.marker_sets:
            raise BodyError(choices(f"marker set of body '{self.name}' named", name, self.marker_sets))
        return self.marker_sets[name]

    def alias(self, convention: str, segment: str) -> str:
        """Name of a segment in another convention; its own where that has none."""
        return self.aliases.get(convention, {}).get(segment, segment)

    def points_rest(self, points: PointSet) -> NDArray:
        """(K, 3) [m] points in the root frame at rest, as kernels take them."""
        return points.points + self.tree.rest[points.segments]

    def positions(self, state: BodyState, points: PointSet) -> NDArray:
        """(K, 3) [m] points in the world at a state."""
        frames, _ = self.tree.forward(state.T_world_root, state.angles)
        out = np.empty((len(points), 3))
        _kernels.place(frames, points.segments, self.points_rest(points), out)
        return out

    def trajectories(self, Ts_world_root: NDArray, angles: NDArray, points: PointSet) -> NDArray:
        """(F, K, 3) [m] points in the world over time: roots (F, 4, 4), angles (F, D)."""
        Ts = self.tree.segment_poses(Ts_world_root, angles)
        return se3.apply(Ts[:, points.segments], points.points)

    def scaled(self, scales: NDArray) -> Body:
        """The body with every scale group but gear's stretched: (G,) factors; joints and points move along."""
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
            self,
            tree=tree,
            landmarks=_stretch(self.landmarks, per_segment),
            keypoint_sets={name: _stretch(s, per_segment) for name, s in self.keypoint_sets.items()},
            marker_sets={name: _stretch(s, per_segment) for name, s in self.marker_sets.items()},
            surfaces=tuple(surface.scaled(float(per_segment[surface.segment])) for surface in self.surfaces),
            morphs=tuple(morph.stretched(old, tree, per_segment) for morph in self.morphs),
            skin=self.skin and self.skin.stretched(old.rest, tree.rest, per_segment),
        )
        return replace(stretched, stature=self.stature * stretched._extent() / max(self._extent(), 1e-9))

    @property
    def gear_scale(self) -> NDArray:
        """(G,) bool, the scale group of gear, which no person's size stretches."""
        return np.array([name == FIXED for name in self.scale_groups], bool)

    def _extent(self) -> float:
        """[m] from the lowest to the highest landmark or joint at rest."""
        heights = np.concatenate([self.points_rest(self.landmarks)[:, 1], self.tree.rest[:, 1]])
        return float(np.ptp(heights)) if len(heights) else 0.0

    def with_keypoints(self, name: str, points: NDArray) -> Body:
        """The body with the points (K, 3) [m] of one keypoint set replaced (learnt offsets)."""
        old = self.keypoints(name)
        return replace(self, keypoint_sets={**self.keypoint_sets, name: PointSet(old.names, old.segments, points)})

    @cached_property
    def offset_shares(self) -> NDArray:
        """(S,) how far points of detectors stand from their places on each segment, as a share of that on long ones."""
        tree, x = self.tree, self.landmarks
        reach = np.zeros(len(tree.segments))
        np.maximum.at(reach, x.segments, np.linalg.norm(x.points, axis=1))
        np.maximum.at(reach, tree.parents[1:], np.linalg.norm(tree.offsets[1:], axis=1))
        return np.where(reach > 0.0, np.minimum(reach / _LONG, 1.0), 1.0)

    @cached_property
    def surface_tables(self) -> SurfaceTables:
        """All surfaces as the kernels that search them take them, packed once."""
        return tables(self.surfaces, self.tree.rest)

    def segment_ends(self) -> dict[int, NDArray]:
        """(3,) [m] far end of each segment that has a surface, in its frame: of the first one that its file gives."""
        ends: dict[int, NDArray] = {}
        for surface in reversed(self.surfaces):
            if isinstance(surface, TaperedCylinder):
                ends[surface.segment] = np.array(surface.end)
            else:
                ends[surface.segment] = surface.vertices[np.argmax(np.linalg.norm(surface.vertices, axis=1))]
        return ends

    def segment_lengths(self) -> dict[str, float]:
        """[m] distance between the two joints of every scale group that has a child joint (bone lengths)."""
        out: dict[str, float] = {}
        for child, parent in enumerate(self.tree.parents):
            if parent >= 0:
                name = f"{self.tree.segments[parent]}-{self.tree.segments[child]}"
                out[name] = float(np.linalg.norm(self.tree.offsets[child]))
        return out


def _stretch(points: PointSet, per_segment: NDArray) -> PointSet:
    return PointSet(points.names, points.segments, points.points * per_segment[points.segments][:, None])
