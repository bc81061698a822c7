"""The person's own shape from silhouettes: lengths, girths and offsets of the surfaces, from many frames and views.

Gauss-Newton over the poses of some frames and all shape parameters together: the body's rims should lie on the
outlines. How a rim moves with a parameter is told by meshes of bodies that differ in it a little, so that any family of
bodies will do whose meshes have the same triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.morphing import Morphing
from kinefit.bodies.surfaces import Surface, TaperedCylinder
from kinefit.correspondences.morphed import toward_tangents
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteFrame
from kinefit.rows import Rows
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.silhouette import SilhouetteMeasurement
from kinefit.sensors.surface import Surface as Drawn
from kinefit.solvers.equations import design
from kinefit.solvers.least_squares import bounds_of

# Standard deviations between people: of a length that is about known, of the logarithm of a half axis (ANSUR II: girths
# by 10 %; a body of cylinders differs from a person's by as much again), of where a surface lies about its bone.
LENGTH, GIRTH, OFFSET = 0.03, 0.2, 0.015
_BOUNDS = (0.08, 0.05, 0.03)  # [m] of correspondences, coarse to fine; the last for all further iterations
_STEP = 1e-3  # of a parameter, from which derivatives are taken
_ANEW = (0, 3)  # iterations in which derivatives are found anew: they change by as little as the logarithms do
_FAR = 0.15  # most that a parameter changes in one iteration


class BodyFamily(Protocol):
    """Bodies of one tree and one set of triangles, by shape parameters that are zero for the usual one."""

    names: tuple[str, ...]
    std: NDArray

    def at(self, values: NDArray) -> Body:
        """The body with parameters (P,)."""
        ...


class CylinderFamily:
    """A body of tapered cylinders with lengths, half axes and forward offsets; both sides alike.

    Parameters
    ----------
    body : Body
    lengths : bool, whether lengths may change too.

    Attributes
    ----------
    names : (P,)
    std : (P,) standard deviation of each parameter: logarithms of lengths and half axes, offsets in metres / 10.
    """

    def __init__(self, body: Body, *, lengths: bool = True) -> None:
        if not any(isinstance(s, TaperedCylinder) for s in body.surfaces):
            raise BodyError(f"body '{body.name}' has no cylinders", remedy="Give its segments a `surface`.")
        self.body = body
        groups: dict[tuple[str, int], int] = {}
        count = [0] * len(body.tree.segments)
        self._group = []
        for s in body.surfaces:
            name = body.tree.segments[s.segment]
            key = name.removesuffix("_r").removesuffix("_l"), count[s.segment]
            count[s.segment] += 1
            self._group.append(groups.setdefault(key, len(groups)))
        self._lengths = len(body.scale_groups) if lengths else 0
        told = [f"{name} {number}".removesuffix(" 0") for name, number in groups]
        kinds = ("start a", "start b", "end a", "end b", "start offset", "end offset")
        self.names = (*body.scale_groups[: self._lengths], *(f"{name} {kind}" for name in told for kind in kinds))
        one = [GIRTH] * 4 + [10.0 * OFFSET] * 2
        self.std = np.array([LENGTH] * self._lengths + one * len(groups))

    def at(self, values: NDArray) -> Body:
        """The body with parameters (P,)."""
        scales = np.ones(len(self.body.scale_groups))
        scales[: self._lengths] = np.exp(values[: self._lengths])
        body, sizes = self.body.scaled(scales), values[self._lengths :].reshape(-1, 6)
        surfaces = tuple(_shaped(s, sizes[g]) for s, g in zip(body.surfaces, self._group))
        return replace(body, surfaces=surfaces)


def _shaped(surface: Surface, size: NDArray) -> Surface:
    if not isinstance(surface, TaperedCylinder):
        return surface
    (a0, b0), (a1, b1) = (np.exp(size[:4].reshape(2, 2)) * surface.radii).tolist()
    a = surface.axes[0]
    start, end = (np.add(at, 0.1 * shift * a) for at, shift in zip((surface.start, surface.end), size[4:]))
    return replace(
        surface, start=tuple(start.tolist()), end=tuple(end.tolist()), radii=((a0, b0), (a1, b1)),
        side=tuple(a.tolist()),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A body of the person's shape.

    Parameters
    ----------
    body : Body
    states : the poses of the frames, refined along
    names, values, std : (P,) of the shape parameters; as wide as their priors where nothing tells of them
    residual, before : float [px] root mean square distance of rims from outlines, afterwards and before
    """

    body: Body
    states: tuple[BodyState, ...]
    names: tuple[str, ...]
    values: NDArray
    std: NDArray
    residual: float
    before: float


def fit_silhouettes(
    family: BodyFamily,
    rig: Rig,
    frames: Sequence[Sequence[SilhouetteFrame]],
    states: Sequence[BodyState],
    *,
    sigma: float = 4.0,
    iterations: int = 8,
    settings: TrackSettings | None = None,
) -> ShapeFit:
    """Shape of a body from its silhouettes in poses that are about known (`BodyFamily`).

    Parameters
    ----------
    frames : K lists of silhouettes, of the cameras that saw the body at one time.
    states : K poses
    sigma : float [px] standard deviation of an outline.

    Raises
    ------
    ObservationError
        No frames, other numbers of frames than of states, masks of another size than their cameras'.
    """
    if not frames or len(frames) != len(states) or not all(len(several) for several in frames):
        problem = f"{len(frames)} frames of silhouettes with {len(states)} states"
        raise ObservationError(problem, remedy="Give one state for each frame, and silhouettes in each.")
    settings = settings or TrackSettings()
    values, poses = np.zeros(len(family.names)), list(states)
    before = 0.0
    for k in range(iterations + 1):
        bound = _BOUNDS[min(k, len(_BOUNDS) - 1)]
        body = family.at(values)
        if k in _ANEW:
            growth = _Growth(family, values)
        here = _Linearised(family, values, body, growth, rig, frames, sigma, settings)
        H, g, square, count = here.equations(poses, bound)
        residual = float(np.sqrt(square / max(count, 1)))
        before = residual if k == 0 else before
        if k == iterations:
            break
        delta = np.linalg.solve(H, g)
        n, bounds = body.tree.n_dofs, bounds_of(body, True)
        poses = [p.retract(d, bounds) for p, d in zip(poses, delta[: len(poses) * n].reshape(-1, n))]
        values = values + np.clip(delta[len(poses) * n :], -_FAR, _FAR)
    std = np.sqrt(np.diag(np.linalg.inv(H))[-len(values) :])
    return ShapeFit(body, tuple(poses), family.names, values, std, residual, before)


class _Growth:
    """How vertices move with every parameter, from bodies that differ in it a little."""

    def __init__(self, family: BodyFamily, values: NDArray) -> None:
        self._usual = Morphing(family.at(values))
        self._larger = [Morphing(family.at(values + step)) for step in _STEP * np.eye(len(values))]

    def at(self, state: BodyState) -> NDArray:
        """(P, V, 3) [m] a unit of each parameter, in the world."""
        usual = self._usual.pose(state).vertices
        return np.stack([(other.pose(state).vertices - usual) / _STEP for other in self._larger])


class _Linearised:
    """The problem about one set of shape parameters."""

    def __init__(
        self, family: BodyFamily, values: NDArray, body: Body, growth: _Growth, rig: Rig,
        frames: Sequence[Sequence[SilhouetteFrame]], sigma: float, settings: TrackSettings,
    ) -> None:  # fmt: skip
        self.family, self.values, self.body, self.rig, self.frames = family, values, body, rig, frames
        self.growth, self.sigma, self.settings, self.surface = growth, sigma, settings, Drawn(body, 1)

    def equations(self, poses: Sequence[BodyState], bound: float) -> tuple[NDArray, NDArray, float, int]:
        """H (Kn + P, Kn + P) and g of all poses, then the shape; Σ of squared distances [px²] and their number."""
        tree, P = self.body.tree, len(self.values)
        n, K = tree.n_dofs, len(poses)
        H, g = np.zeros((K * n + P,) * 2), np.zeros(K * n + P)
        square, count = 0.0, 0
        held = np.isfinite(tree.spread)
        for i, (state, several) in enumerate(zip(poses, self.frames)):
            world = self.surface.pose(state).vertices
            moves = self.growth.at(state)
            own = np.concatenate([np.arange(i * n, (i + 1) * n), np.arange(K * n, K * n + P)])
            for frame in several:
                seen = SilhouetteMeasurement(
                    frame, self.rig[frame.sensor], self.surface, world, self.sigma, self.settings
                )
                rows, points, tangents = seen.linked(state, bound)
                x = points.on(world)
                direction = rows.direction if isinstance(rows, Rows) else toward_tangents(x, seen.camera, tangents)[0]
                A = np.empty((len(rows), n + P))
                A[:, :n] = design(self.body, state, rows)
                one, two, share = points.vertices[:, 0], points.vertices[:, 1], points.share[:, None]
                shifts = (1.0 - share) * moves[:, one] + share * moves[:, two]
                A[:, n:] = np.einsum("ij,kij->ik", direction, shifts)
                w = rows.weight
                H[np.ix_(own, own)] += A.T @ (w[:, None] * A)
                g[own] += A.T @ (w * rows.residual)
                scale = seen.pixels_per_metre
                square, count = square + float(np.sum((scale * rows.residual) ** 2)), count + len(rows)
            angles = i * n + 6 + np.flatnonzero(held)
            H[angles, angles] += 1.0 / tree.spread[held] ** 2
            g[angles] += (tree.usual - state.angles)[held] / tree.spread[held] ** 2
            H[np.arange(i * n, (i + 1) * n), np.arange(i * n, (i + 1) * n)] += 10.0  # [1/m², 1/rad²]: a step of 0.3
        at = np.arange(K * n, K * n + P)
        H[at, at] += 1.0 / self.family.std**2
        g[at] -= self.values / self.family.std**2
        return H, g, square, count
