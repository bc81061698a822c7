"""The person's own size from the first depth frames: lengths of the limbs and girths of the surfaces.

Gauss-Newton over the poses of a few frames and the logarithms of all sizes together: every measured point should lie
on the surface nearest to it (point to plane), and no contour of the body should stand out where the sensor saw past it.
Priors hold what was not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import Surface, TaperedCylinder, nearest
from kinefit.bodies.surfaces.nearest import Nearest
from kinefit.bodies.surfaces.triangles import body_mesh
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.initialization.depth_score import spreads
from kinefit.sensors.depth_view import DepthView, outside, splat, view_of
from kinefit.solvers.least_squares import bounds_of

# Standard deviations of the logarithm of sizes between people (adults' stature varies by 4 %, one limb's length for
# a given stature by about as much; girths by 10 %, ANSUR II; loose clothes double that).
STATURE, LENGTH, GIRTH = 0.10, 0.05, 0.20
INDEPENDENT = 80  # points of a frame that err on their own: neighbours share folds of cloth and the model's form
BOUND = 0.15  # [m] farther points are not the surface's


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A body of the person's size.

    Parameters
    ----------
    body : Body
    states : the poses of the frames, refined along
    names : (P,) of the sizes: a scale group (length), and its girth along both half axes
    factors : (P,) by which each changed; lengths count for girths too
    std : (P,) standard deviation of each logarithm; as wide as the prior where nothing was seen
    residual : float [m] median distance of the points that take part; before it was `before`
    """

    body: Body
    states: tuple[BodyState, ...]
    names: tuple[str, ...]
    factors: NDArray
    std: NDArray
    residual: float
    before: float


def fit_surfaces(
    body: Body,
    clouds: Sequence[ArrayLike],
    states: Sequence[BodyState],
    *,
    camera: Camera | None = None,
    views: Sequence[DepthView] = (),
    sigma: float = 0.01,
    points: int = 500,
    iterations: int = 20,
) -> SurfaceFit:
    """Lengths and girths of a body from clouds of the person in poses that are about known.

    Parameters
    ----------
    clouds : K x (N, 3) [m] points on the person, in the world
    states : K poses
    camera : Camera of the sensor, one for all: surfaces that face away from it attract nothing, and what its image
        shows empty about the person holds the girths from growing
    views : K, the same from whole depth images, instead of a camera
    sigma : float [m], of a point: noise, cloth
    points : int of each cloud that take part
    iterations : int, at most

    Returns
    -------
    SurfaceFit
        The body as it was given where nothing better was found.

    Raises
    ------
    ObservationError
        No clouds, other numbers of clouds than of states, or empty ones.
    BodyError
        The body has no surfaces.
    """
    if camera is not None and not views:
        views = [_view(np.asarray(cloud, float).reshape(-1, 3), camera) for cloud in clouds]
    problem = _Problem.of(body, clouds, states, views, sigma, points)
    groups = np.arange(len(problem.names)) < len(body.scale_groups)
    # closest points slide along limbs and make lengths slow to change: three statures, then the best goes on
    tried = [problem.minimised(problem.start(step * groups), iterations // 4) for step in (-STATURE, 0.0, STATURE)]
    best = problem.minimised(min(tried, key=problem.cost), iterations)
    if problem.cost(best) >= problem.cost(problem.start()):
        best = problem.start()
    H, _ = problem.equations(best)
    count = len(problem.names)
    std = np.sqrt(np.diag(np.linalg.inv(H))[-count:])
    return SurfaceFit(
        problem.body_of(best.sizes), best.states, problem.names, np.exp(best.sizes), std,
        problem.median(best), problem.median(problem.start()),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Point:
    """Where the fit stands: poses, and logarithms of sizes (P,)."""

    states: tuple[BodyState, ...]
    sizes: NDArray


@dataclass(frozen=True, eq=False)
class _Problem:
    body: Body
    clouds: tuple[NDArray, ...]
    given: tuple[BodyState, ...]
    views: tuple[DepthView, ...]  # of the clouds, or none
    sigma: float
    names: tuple[str, ...]
    girths: tuple[int, ...]  # scale groups with cylinders

    @classmethod
    def of(
        cls, body: Body, clouds: Sequence[ArrayLike], states: Sequence[BodyState], views: Sequence[DepthView],
        sigma: float, points: int,
    ) -> _Problem:  # fmt: skip
        if not body.surfaces:
            raise BodyError(f"body '{body.name}' has no surfaces", remedy="See the catalogue's bodies.")
        if not len(clouds) or len(clouds) != len(states):
            raise ObservationError(f"{len(clouds)} clouds with {len(states)} states", remedy="Give one state a cloud.")
        rng, kept = np.random.default_rng(0), []
        for cloud in clouds:
            x = np.asarray(cloud, float).reshape(-1, 3)
            x = x[np.isfinite(x).all(axis=1)]
            if not len(x):
                raise ObservationError("a cloud without points", remedy="Leave that frame out.")
            kept.append(x[rng.permutation(len(x))[:points]])
        groups = {int(body.segment_scale[c.segment]) for c in body.surfaces if isinstance(c, TaperedCylinder)}
        girths = tuple(sorted(groups))
        names = (*body.scale_groups, *(f"{body.scale_groups[g]} girth {axis}" for axis in "ab" for g in girths))
        return cls(body, tuple(kept), tuple(states), tuple(views), sigma, names, girths)

    def start(self, sizes: NDArray | float = 0.0) -> _Point:
        return _Point(self.given, sizes + np.zeros(len(self.names)))

    def minimised(self, point: _Point, iterations: int) -> _Point:
        """Gauss-Newton with Marquardt's damping, at most so many steps."""
        cost, damping = self.cost(point), 1e-3
        for _ in range(iterations):
            H, g = self.equations(point)
            while damping < 1e3:
                trial = self.moved(point, np.linalg.solve(H + damping * np.diag(np.diag(H)), g))
                value = self.cost(trial)
                if value < cost:
                    break
                damping *= 10.0
            else:
                return point
            fell, point, cost, damping = cost - value, trial, value, max(0.3 * damping, 1e-4)
            if fell < 1e-4 * cost:
                return point
        return point

    def body_of(self, sizes: NDArray) -> Body:
        """The body with other sizes, given as logarithms (P,)."""
        groups, k = len(self.body.scale_groups), len(self.girths)
        scaled = self.body.scaled(np.exp(sizes[:groups]))
        girth = np.ones((groups, 2))
        girth[list(self.girths)] = np.exp(sizes[groups:].reshape(2, k).T)
        per_segment = girth[self.body.segment_scale]
        return replace(scaled, surfaces=tuple(_thicker(s, per_segment[s.segment]) for s in scaled.surfaces))

    def moved(self, p: _Point, delta: NDArray) -> _Point:
        n = self.body.tree.n_dofs
        bounds = bounds_of(self.body, True)
        states = tuple(s.retract(delta[i * n : (i + 1) * n], bounds) for i, s in enumerate(p.states))
        return _Point(states, p.sizes + np.clip(delta[len(states) * n :], -0.15, 0.15))

    def _matched(self, body: Body, state: BodyState, i: int, bound: float = BOUND) -> Nearest:
        """The surface nearest to each point of a cloud; segment -1 where none is, or it faces away."""
        found = nearest(body, state, self.clouds[i], max_distance=bound)
        if not self.views:
            return found
        away = np.einsum("ij,ij->i", found.normal, self.views[i].viewpoint - found.point) <= 0
        return found._replace(segment=np.where(away, -1, found.segment), distance=np.where(away, bound, found.distance))

    def _protruding(self, body: Body, state: BodyState, i: int) -> tuple[NDArray, NDArray, NDArray, int]:
        """Points (M, 3) [m] on the person's outline where the body's occluding contour (M,) segments should recede to.

        Also how sure (M,) that is, and the number of points of the body's surface that were asked.
        """
        mesh = body_mesh(body, around=12, along=5)
        if not self.views:
            return np.empty((0, 3)), np.empty(0, int), np.empty(0), len(mesh.vertices)
        frames, _ = body.tree.forward(state.T_world_root, state.angles)
        x = mesh.posed(frames)
        view = self.views[i]
        out, trust = outside(view, x)
        some = np.flatnonzero((out > 0) & (trust > 0))
        rim = nearest(body, state, x[some], max_distance=BOUND, only=mesh.segment[some])
        sight = x[some] - view.viewpoint
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        across = np.abs(np.einsum("ij,ij->i", rim.normal, sight)) < 0.5  # elsewhere receding does not help
        some, n = some[across], rim.normal[across]
        return x[some] - out[some, None] * n, mesh.segment[some].astype(int), trust[some], len(mesh.vertices)

    def median(self, p: _Point) -> float:
        """[m] distance of the points that have a surface."""
        body, found = self.body_of(p.sizes), []
        for i, state in enumerate(p.states):
            match = self._matched(body, state, i)
            found.append(np.abs(match.distance[match.segment >= 0]))
        d = np.concatenate(found)
        return float(np.median(d)) if len(d) else float("nan")

    @property
    def _soft(self) -> float:
        return 3.0 * self.sigma  # [m] from where a point gives way

    def cost(self, p: _Point) -> float:
        """What is minimised."""
        total, body = self._prior_cost(p), self.body_of(p.sizes)
        for i, state in enumerate(p.states):
            d = self._matched(body, state, i).distance
            s2 = (d / self._soft) ** 2
            total += float(np.mean(s2 / (1 + s2))) * self._unit
            x, segment, trust, asked = self._protruding(body, state, i)
            if len(x):
                s2 = (nearest(body, state, x, max_distance=BOUND, only=segment).distance / self._soft) ** 2
                total += float(np.sum(trust * s2 / (1 + s2))) / asked * self._unit
        return total

    @property
    def _unit(self) -> float:
        return float(INDEPENDENT * (self._soft / self.sigma) ** 2)

    def _prior_cost(self, p: _Point) -> float:
        tree = self.body.tree
        odd = sum(float(np.sum(((s.angles - tree.usual) / (2 * spreads(self.body))) ** 2)) for s in p.states)
        return odd + float(p.sizes @ self._size_information @ p.sizes)

    @property
    def _size_information(self) -> NDArray:
        groups, k = len(self.body.scale_groups), len(self.girths)
        C = np.zeros((len(self.names),) * 2)
        C[:groups, :groups] = STATURE**2 + LENGTH**2 * np.eye(groups)
        C[groups:, groups:] = GIRTH**2 * (0.5 * np.eye(2 * k) + 0.5)
        return np.linalg.inv(C)

    def equations(self, p: _Point) -> tuple[NDArray, NDArray]:
        """H (n, n) and g (n,) of all poses, then sizes."""
        tree, n, P, K = self.body.tree, self.body.tree.n_dofs, len(self.names), len(p.states)
        H, g = np.zeros((K * n + P,) * 2), np.zeros(K * n + P)
        body = self.body_of(p.sizes)
        step = 1e-3
        larger = [self.body_of(p.sizes + step * row) for row in np.eye(P)]
        spread = 2 * spreads(self.body)
        for i, (cloud, state) in enumerate(zip(self.clouds, p.states)):
            found = self._matched(body, state, i)
            use = found.segment >= 0
            rim, rim_segment, trust, asked = self._protruding(body, state, i)
            x, segment = np.concatenate([cloud[use], rim]), np.concatenate([found.segment[use], rim_segment])
            share = np.concatenate([np.full(use.sum(), 1.0 / len(cloud)), trust / asked])
            found = nearest(body, state, x, max_distance=2 * BOUND, only=segment)
            d, normal = found.distance, found.normal
            w = share * INDEPENDENT / self.sigma**2 / (1 + (d / self._soft) ** 2) ** 2
            A = np.zeros((len(x), n + P))
            A[:, :n] = _pose_columns(body, state, x - d[:, None] * normal, normal, segment)
            for k, more in enumerate(larger):
                ahead = nearest(more, state, x, max_distance=2 * BOUND, only=segment).distance
                A[:, n + k] = np.clip((d - ahead) / step, -2.0, 2.0)  # [m] per logarithm: bodies are small
            own = np.concatenate([np.arange(i * n, (i + 1) * n), np.arange(K * n, K * n + P)])
            H[np.ix_(own, own)] += A.T @ (w[:, None] * A)
            g[own] += A.T @ (w * d)
            angles = i * n + np.arange(6, n)
            H[angles, angles] += 1 / spread**2
            g[angles] += (tree.usual - state.angles) / spread**2
            H[np.arange(i * n, i * n + 6), np.arange(i * n, i * n + 6)] += 1.0  # [1/m², 1/rad²] a metre, a radian
        S = self._size_information
        H[K * n :, K * n :] += S
        g[K * n :] -= S @ p.sizes
        return H, g


def _thicker(surface: Surface, girth: NDArray) -> Surface:
    if not isinstance(surface, TaperedCylinder):
        return surface
    (a0, b0), (a1, b1) = (np.array(surface.radii) * girth).tolist()
    return replace(surface, radii=((a0, b0), (a1, b1)))


def _pose_columns(body: Body, state: BodyState, point: NDArray, normal: NDArray, segment: NDArray) -> NDArray:
    """(N, 6 + D) how far each point's surface moves along its normal with every degree of freedom."""
    _, screws = body.tree.forward(state.T_world_root, state.angles)
    arm = point - state.T_world_root[:3, 3]
    a = np.concatenate([normal, np.cross(arm, normal)], axis=1)
    out = np.empty((len(point), body.tree.n_dofs))
    for s in np.unique(segment):
        of = segment == s
        out[of] = a[of] @ body.tree.segment_jacobian(screws, int(s))
    return out


def _view(cloud: NDArray, camera: Camera) -> DepthView:
    depth, small = splat(cloud[np.isfinite(cloud).all(axis=1)], camera)
    return view_of(depth, depth > 0, small)
