"""Search for a posture in a view: the trunk first, then limb after limb, then all of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.fingers import knuckles
from kinefit.bodies.limbs import limbs
from kinefit.correspondences import prior_rows, surface_rows
from kinefit.initialization._kernels_reach import reach
from kinefit.initialization.depth_score import TOLERANCE, Score, spreads
from kinefit.losses import geman_mcclure
from kinefit.rows import AnyRows
from kinefit.sensors.surfaces.depth_view import DepthView, geodesic_ends
from kinefit.solvers.least_squares import bounds_of, gauss_newton

POINTS = 700  # measured points that take part in a fit: more do not distinguish postures better
FACING = 0.02  # of the score: a person rather faces the sensor (twice that for one turned away) ...
UPRIGHT = 0.05  # ... and stands or sits upright (that for one who lies); for what is alike from both sides
AS_BEFORE = 0.1  # instead, where it is known how a body faced a moment ago: twice that for one that has turned about
YAWS, LEANS = np.arange(0.0, 2 * np.pi, np.pi / 6), ((0, 0), (20, 0), (45, 0), (-20, 0), (0, 20), (0, -20))  # [deg]
TRIES, ROUGH_TRIES = 200, 100  # random poses of a limb: one that is to stay, and one for each place of the trunk
_MIN_LIMB_PIXELS = 4  # of a view: fewer show nothing of a limb
_MIN_UNEXPLAINED = 0.01  # share of a person's pixels that may be a limb's end: a hand has 2 %
STEP = (0.04, 0.2, 0.35)  # [m, rad, rad] first random steps of the root's place and turn, and of angles


@dataclass(frozen=True, eq=False)
class PostureSearch:
    """Tries postures of a body in a view.

    Parameters
    ----------
    body : Body
    view : DepthView
    up : (3,) unit, in the world
    rng : what random tries are drawn from
    forward : (3,) unit, where the root faced a moment ago; None where that is not known
    """

    body: Body
    view: DepthView
    up: NDArray
    rng: np.random.Generator
    forward: NDArray | None = None

    @cached_property
    def score(self) -> Score:
        """What decides."""
        return Score(self.body, self.view)

    @cached_property
    def limbs(self) -> tuple[tuple[int, ...], ...]:
        """Limbs of several segments."""
        return tuple(limb for limb in limbs(self.body) if len(limb) > 1)

    @cached_property
    def points(self) -> NDArray:
        """(N, 3) [m] some of what was measured."""
        cloud = self.view.cloud
        return cloud[self.rng.permutation(len(cloud))[:POINTS]]

    def value(self, state: BodyState) -> float:
        """Score of a state, less what it costs to stand the other way."""
        return self.score.of(state) - float(self.stance(state.T_world_root[None])[0])

    def stance(self, roots: NDArray) -> NDArray:
        """(B,) what it costs to turn the back on the sensor, or on where one faced before, and to lie."""
        sight = self.view.viewpoint - roots[:, :3, 3]
        sight = sight - (sight @ self.up)[:, None] * self.up
        sight /= np.linalg.norm(sight, axis=1, keepdims=True) + 1e-9
        weight, facing = FACING, np.einsum("ij,ij->i", roots[:, :3, 0], sight)
        if self.forward is not None:
            weight, facing = AS_BEFORE, roots[:, :3, 0] @ self.forward
        cost: NDArray = weight * (1 - facing) + UPRIGHT * (1 - roots[:, :3, 1] @ self.up)
        return cost

    def trunks(self, count: int) -> list[BodyState]:
        """The best places of trunk and head, the limbs at the prior mean: put behind thick parts, turned every way."""
        roots = self._places()
        angles = np.repeat(self.body.usual_state().angles[None], len(roots), axis=0)
        core = self.score.core
        values = self.score(roots, angles, core) - self.stance(roots)
        tried = []
        for k in _apart(roots, values, 3 * count):
            state, value = self.polish(BodyState(roots[k], angles[k]), core, self._dofs(core, True), 4, 32)
            tried.append((value - float(self.stance(state.T_world_root[None])[0]), state))
        kept = _apart(np.array([s.T_world_root for _, s in tried]), np.array([v for v, _ in tried]), count)
        return [tried[k][1] for k in kept]

    def _places(self) -> NDArray:
        """(B, 4, 4) roots to try."""
        view, mesh = self.view, self.score.mesh
        thick = view.thickness
        at = np.argwhere(thick > 0.4 * thick.max())
        at = at[self.rng.permutation(len(at))[:40]]
        x = mesh.vertices[np.isin(mesh.segment, self.score.trunk)]
        low, high = (x.min(axis=0), x.max(axis=0)) if len(x) else (np.zeros(3), np.zeros(3))
        centre, half, tall = 0.5 * (low + high), 0.5 * (high - low).min(), 0.2 * (high - low)[1]
        sight = view.points[at[:, 0], at[:, 1]].mean(axis=0) - view.viewpoint
        sight /= np.linalg.norm(sight)
        turns = self._turns(sight)
        roots = []
        for row, column in at:
            p = view.points[row, column]
            for R in turns:
                for shift in (-tall, 0.0, tall):
                    T = np.eye(4)
                    T[:3, :3] = R
                    T[:3, 3] = p + half * sight - R @ (centre + (0.0, shift, 0.0))
                    roots.append(T)
        return np.array(roots)

    def _turns(self, sight: NDArray) -> list[NDArray]:
        """Rotations of the root: facing the sensor and turned in steps, upright and leaning."""
        up = self.up
        forward = -sight + (sight @ up) * up
        if np.linalg.norm(forward) < 1e-3:  # seen from above
            forward = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        forward /= np.linalg.norm(forward)
        out = []
        for yaw in YAWS:
            f = np.cos(yaw) * forward + np.sin(yaw) * np.cross(up, forward)
            for lean, side in np.radians(LEANS):
                y = np.cos(side) * (np.cos(lean) * up + np.sin(lean) * f) + np.sin(side) * np.cross(f, up)
                z = np.cross(f, y)
                z /= np.linalg.norm(z)
                out.append(np.stack([np.cross(y, z), y, z], axis=1))
        return out

    def _dofs(self, segments: tuple[int, ...], root: bool) -> NDArray:
        angles = 6 + np.flatnonzero(np.isin(self.body.tree.owners, segments))
        return np.concatenate([np.arange(6), angles]) if root else angles

    def polish(
        self, state: BodyState, drawn: tuple[int, ...] | None, dofs: NDArray, rounds: int, count: int,
        size: float = 1.0, **held: Any,
    ) -> tuple[BodyState, float]:  # fmt: skip
        """Better by random steps of some degrees of freedom, smaller whenever none helps; and the score.

        `held`: moving and base, as the score takes them.
        """
        sigma = size * np.repeat((*STEP,), (3, 3, len(state.angles)))[dofs]
        bounds = bounds_of(self.body, True)
        best = float(self.score(state.T_world_root[None], state.angles[None], drawn, **held)[0])
        for _ in range(rounds):
            delta = np.zeros((count, 6 + len(state.angles)))
            few = self.rng.random((count, len(dofs))) < np.where(np.arange(count) % 2, 1.0, 0.5)[:, None]
            delta[:, dofs] = self.rng.normal(size=few.shape) * sigma * few
            roots = np.repeat(state.T_world_root[None], count, axis=0)
            if dofs[0] < 6:
                roots = np.array([state.retract(d).T_world_root for d in delta])
            angles = np.clip(state.angles + delta[:, 6:], *bounds)
            values = self.score(roots, angles, drawn, **held)
            k = int(np.argmax(values))
            if values[k] > best:
                best, state = float(values[k]), BodyState(roots[k], angles[k])
            else:
                sigma = 0.5 * sigma
        return state, best

    def limb(
        self, state: BodyState, limb: tuple[int, ...], drawn: tuple[int, ...] | None, ends: NDArray, count: int
    ) -> list[tuple[BodyState, float]]:
        """The best poses of one limb, all else held, and their scores: random ones, its tip or its fist at each end.

        A rough search, of fewer than `TRIES` random poses, leaves out closest points.
        """
        tree = self.body.tree
        dofs = self._dofs(limb, False)
        d = dofs - 6
        low, high = np.maximum(tree.lower[d], -np.pi), np.minimum(tree.upper[d], np.pi)
        anywhere = self.rng.uniform(low, high, size=(count, len(d)))
        usual = self.rng.normal(tree.usual[d], np.minimum(spreads(self.body)[d], 0.6), size=(count, len(d)))
        angles = np.repeat(state.angles[None], 1 + count, axis=0)
        angles[1:, d] = np.clip(np.where(self.rng.random((count, 1)) < 0.35, usual, anywhere), low, high)
        angles = np.concatenate([angles, self._reaching(state, limb, ends)])
        drawn = tuple(range(len(tree.segments))) if drawn is None else drawn
        others = tuple(s for s in drawn if s not in limb)
        held: dict[str, Any] = {"moving": limb, "base": self.score.depth(state, others)}
        values = self.score(np.repeat(state.T_world_root[None], len(angles), axis=0), angles, drawn, **held)
        best = [BodyState(state.T_world_root, angles[k]) for k in np.argsort(-values)[:4]]
        rough = sorted((self.polish(s, drawn, dofs, 3, 24, **held) for s in best), key=lambda b: -b[1])
        locked = np.ones(tree.n_dofs, bool)
        locked[dofs] = False
        closer = [self.closest(s, 8, locked=locked) for s, _ in rough[:2]] if count >= TRIES else []
        out = [*rough, *(self.polish(s, drawn, dofs, 3, 24, 0.4, **held) for s in closer)]
        return sorted(out, key=lambda b: -b[1])

    def _is_out_of_view(self, state: BodyState, limb: tuple[int, ...], drawn: tuple[int, ...]) -> bool:
        """Whether the view shows nothing of a limb where it is, nor anything unexplained that it could reach."""
        view = self.view
        if ((self.score.depth(state, limb) < view.behind) & (view.trust > 0)).sum() > _MIN_LIMB_PIXELS:
            return False
        explained = np.abs(self.score.depth(state, drawn) - view.observed) < TOLERANCE
        near = self.within_reach(state, limb, view.points[view.seen & ~explained])
        return bool(near.sum() < _MIN_UNEXPLAINED * self.score.pixels)

    def within_reach(self, state: BodyState, limb: tuple[int, ...], x_world: NDArray) -> NDArray:
        """(N,) bool: points (N, 3) [m] that a limb could touch."""
        tree, mesh = self.body.tree, self.score.mesh
        frames, _ = tree.forward(state.T_world_root, state.angles)
        root = tree.rest[limb[0]] @ frames[limb[0], :9].reshape(3, 3).T + frames[limb[0], 9:]
        own = mesh.vertices[np.isin(mesh.segment, limb)] - tree.rest[limb[0]]
        return np.asarray(np.linalg.norm(x_world - root, axis=1) < np.linalg.norm(own, axis=1).max(initial=0.0))

    @cached_property
    def _tips(self) -> dict[int, NDArray]:
        """Limb's last segment -> its far end, stretched and in a fist (2, 3) [m] in that segment's frame."""
        out, tree, mesh, folded = {}, self.body.tree, self.score.mesh, knuckles(self.body)
        for limb in self.limbs:
            x = mesh.vertices[mesh.segment == limb[-1]] - tree.rest[limb[-1]]
            far = np.linalg.norm(x, axis=1)
            tip = x[far > 0.95 * far.max()].mean(axis=0) if len(x) else np.zeros(3)
            out[limb[-1]] = np.stack([tip, folded.get(limb[-1], tip)])
        return out

    def _reaching(self, state: BodyState, limb: tuple[int, ...], ends: NDArray) -> NDArray:
        """(2 E, D) angles that bring a limb's tip, and its fist, to ends of the surface, from random poses of it."""
        tree, d = self.body.tree, self._dofs(limb, False) - 6
        sight = (ends - self.view.viewpoint) / np.linalg.norm(ends - self.view.viewpoint, axis=1, keepdims=True)
        targets = np.tile(ends + 0.03 * sight, (2, 1))  # [m] the tip lies within, half a wrist behind what was seen
        tips = np.repeat(self._tips[limb[-1]] + tree.rest[limb[-1]], len(ends), axis=0)
        angles = np.repeat(state.angles[None], len(targets), axis=0)
        some = self.rng.normal(tree.usual[d], 0.5, size=(len(targets), len(d)))
        angles[:, d] = np.clip(some, tree.lower[d], tree.upper[d])
        reach(
            tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, state.T_world_root, angles, d, limb[-1],
            tips, targets, tree.usual, spreads(self.body), tree.lower, tree.upper, 0.03, 10,
        )  # fmt: skip
        return angles

    def ends(self, state: BodyState) -> NDArray:
        """(E, 3) [m] ends of the person's limbs, seen from the middle of the trunk."""
        mesh = self.score.mesh
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        x = mesh.posed(frames)[np.isin(mesh.segment, self.score.trunk)]
        return geodesic_ends(self.view, x.mean(axis=0) if len(x) else state.T_world_root[:3, 3])

    def closest(
        self, state: BodyState, iterations: int = 12, first: float = 0.15, locked: NDArray | None = None
    ) -> BodyState:
        """Iterated closest points: measured points onto the surface (point to plane), robust, within the limits."""
        body, bound = self.body, first
        sigma = 2.0 * spreads(body)
        for _ in range(iterations):
            rows = surface_rows(body, state, self.points, max_distance=bound, sigma=0.02, viewpoint=self.view.viewpoint)
            parts: list[AnyRows] = [rows, prior_rows(body, state, sigma=sigma)]
            damping = 30.0 * max(len(rows), 1)  # of what a row weighs a percent: parts seen from one side stay
            state = gauss_newton(body, state, parts, loss=geman_mcclure(2.0), damping=damping, locked=locked).state
            bound = max(0.8 * bound, 0.06)
        return state

    def best(self, count: int) -> list[BodyState]:
        """The best postures, best first."""
        found = []
        for state in self.trunks(8):
            ends, drawn = self.ends(state), self.score.core
            for limb in self.limbs:
                drawn = (*drawn, *limb)
                if not self._is_out_of_view(state, limb, drawn):
                    state = self.limb(state, limb, drawn, ends, ROUGH_TRIES)[0][0]
            found.append((self.value(state), state, ends))
        found.sort(key=lambda f: -f[0])
        once = [(self.refined(state, ends, 1), ends) for _, state, ends in found[:3]]
        once.sort(key=lambda f: -self.value(f[0]))
        out = [self.refined(state, ends, 1) if k < 1 else state for k, (state, ends) in enumerate(once)]
        return sorted(out, key=lambda s: -self.value(s))[:count]

    def refined(self, state: BodyState, ends: NDArray, rounds: int = 2) -> BodyState:
        """A posture brought closer: points onto surfaces, each limb tried anew, random steps of everything."""
        everything, everything_drawn = np.arange(self.body.tree.n_dofs), tuple(range(len(self.body.tree.segments)))
        for _ in range(rounds):
            state = max(state, self.closest(state), key=self.value)
            for limb in self.limbs:
                if not self._is_out_of_view(state, limb, everything_drawn):
                    state = self.limb(state, limb, None, ends, TRIES)[0][0]
            state, _ = self.polish(state, None, everything, 10, 40, 0.4)
        closer = self.closest(state, first=0.10)
        return closer if self.value(closer) > self.value(state) - 0.02 else state  # pixels are coarse, points are not


def _apart(roots: NDArray, values: NDArray, count: int) -> list[int]:
    """The best that differ by 10 cm or 25 degrees from all better ones."""
    out: list[int] = []
    least = 1.0 + 2.0 * np.cos(np.radians(25.0))  # trace of a rotation
    for k in np.argsort(-values):
        R, t = roots[k, :3, :3], roots[k, :3, 3]
        if all(np.linalg.norm(t - roots[m, :3, 3]) > 0.10 or np.sum(R * roots[m, :3, :3]) < least for m in out):
            out.append(int(k))
        if len(out) == count:
            break
    return out
