"""Search for a body's posture in a depth view: first the trunk, then each limb, then everything."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.limbs import knuckles, limbs
from kinefit.fitting.initialization._kernels_reach import reach_for
from kinefit.fitting.initialization.depth_score import MAX_DEPTH_ERROR, Score, prior_sigmas
from kinefit.geometry import se3
from kinefit.geometry.losses import geman_mcclure
from kinefit.sensors.surfaces.depth_view import DepthView, geodesic_ends
from kinefit.solving.correspondences import prior_rows, surface_rows
from kinefit.solving.least_squares import bounds_of, gauss_newton
from kinefit.solving.rows import AnyRows

MAX_POINTS = 700  # measured points in a fit: more do not help
FACING_COST = 0.02  # of the score: people rather face the sensor (twice that for one turned away) ...
UPRIGHT_COST = 0.05  # ... and are rather upright (that for one who lies); resolves ambiguous views
HEADING_COST = 0.1  # instead of FACING_COST with a known heading: twice that for one that has turned around
YAWS = np.arange(0.0, 2 * np.pi, np.pi / 6)
LEANS = ((0, 0), (20, 0), (45, 0), (-20, 0), (0, 20), (0, -20))  # [deg] forwards and sideways
LIMB_TRIES = 200  # random poses of a limb in the refinement
ROUGH_LIMB_TRIES = 100  # the same for each candidate of the trunk
LIMB_CANDIDATES = 3  # of each kind, random and reaching, that are refined
REACHING_STARTS = 3  # random poses of a limb for each end of the surface that it is to reach
_MIN_LIMB_PIXELS = 4  # of a visible limb
_MIN_UNEXPLAINED = 0.01  # of a person's pixels for a limb's end: a hand has 2 %
STEP_SIGMAS = (0.04, 0.2, 0.35)  # [m, rad, rad] initial random steps of the root's position and rotation, and of angles


def towards(sight: NDArray, up: NDArray) -> NDArray:
    """(3,) horizontal unit vector against a line of sight (3,): towards the sensor, any if it looks along `up` (3,)."""
    forward = (sight @ up) * up - sight
    if np.linalg.norm(forward) < 1e-3:  # seen from above
        forward = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return np.asarray(forward / np.linalg.norm(forward))


@dataclass(frozen=True, eq=False)
class PostureSearch:
    """Searches postures of a body in a depth view.

    Parameters
    ----------
    body : Body with surfaces
    view : DepthView
    up : (3,) unit vector in the world
    rng : random generator of the search
    forward : (3,) unit vector, heading of the root a moment ago; None if unknown
    """

    body: Body
    view: DepthView
    up: NDArray
    rng: np.random.Generator
    forward: NDArray | None = None

    @cached_property
    def score(self) -> Score:
        """The score of poses."""
        return Score(self.body, self.view)

    @cached_property
    def limbs(self) -> tuple[tuple[int, ...], ...]:
        """Limbs of several segments."""
        return tuple(limb for limb in limbs(self.body) if len(limb) > 1)

    @cached_property
    def points(self) -> NDArray:
        """(N, 3) [m] a random sample of the measured points."""
        cloud = self.view.cloud
        return cloud[self.rng.permutation(len(cloud))[:MAX_POINTS]]

    def value(self, state: BodyState) -> float:
        """Score of a state minus its stance cost, a number of at most 1."""
        return self.score.of(state) - float(self.stance(state.T_world_root[None])[0])

    def stance(self, roots: NDArray) -> NDArray:
        """(B,) cost of roots (B, 4, 4) that face away from the sensor (or from the former heading), or that lie."""
        sight = self.view.viewpoint - roots[:, :3, 3]
        sight = sight - (sight @ self.up)[:, None] * self.up
        sight /= np.linalg.norm(sight, axis=1, keepdims=True) + 1e-9
        weight, facing = FACING_COST, np.einsum("ij,ij->i", roots[:, :3, 0], sight)
        if self.forward is not None:
            weight, facing = HEADING_COST, roots[:, :3, 0] @ self.forward
        cost: NDArray = weight * (1 - facing) + UPRIGHT_COST * (1 - roots[:, :3, 1] @ self.up)
        return cost

    def trunks(self, count: int) -> list[BodyState]:
        """The best placements of trunk and head, with limbs at the prior mean: behind thick parts, at all headings."""
        roots = self._places()
        angles = np.repeat(self.body.default_state().angles[None], len(roots), axis=0)
        core = self.score.core
        values = self.score(roots, angles, core) - self.stance(roots)
        candidates = []
        for k in _distinct(roots, values, 3 * count):
            state, value = self.polish(BodyState(roots[k], angles[k]), core, self._dofs_of(core, True), 4, 32)
            candidates.append((value - float(self.stance(state.T_world_root[None])[0]), state))
        best = _distinct(np.array([s.T_world_root for _, s in candidates]), np.array([v for v, _ in candidates]), count)
        return [candidates[k][1] for k in best]

    def _places(self) -> NDArray:
        """(B, 4, 4) candidate roots."""
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
                    roots.append(se3.transform(R, p + half * sight - R @ (centre + (0.0, shift, 0.0))))
        return np.array(roots)

    def _turns(self, sight: NDArray) -> list[NDArray]:
        """(3, 3) candidate rotations of the root: headings in steps from the sensor, upright and leaning."""
        up, out = self.up, []
        forward = towards(sight, up)
        for yaw in YAWS:
            f = np.cos(yaw) * forward + np.sin(yaw) * np.cross(up, forward)
            for lean, side in np.radians(LEANS):
                y = np.cos(side) * (np.cos(lean) * up + np.sin(lean) * f) + np.sin(side) * np.cross(f, up)
                z = np.cross(f, y)
                z /= np.linalg.norm(z)
                out.append(np.stack([np.cross(y, z), y, z], axis=1))
        return out

    def _dofs_of(self, segments: tuple[int, ...], root: bool) -> NDArray:
        angles = 6 + np.flatnonzero(np.isin(self.body.tree.owners, segments))
        return np.concatenate([np.arange(6), angles]) if root else angles

    def polish(
        self, state: BodyState, drawn: tuple[int, ...] | None, dofs: NDArray, rounds: int, count: int,
        size: float = 1.0, **held: Any,
    ) -> tuple[BodyState, float]:  # fmt: skip
        """Improve a state by random steps, which shrink whenever none helps; returns it with its score.

        Parameters
        ----------
        drawn : segments that are rendered; None: all
        dofs : (d,) int, degrees of freedom that move
        rounds, count : number of rounds, and of steps per round
        size : factor on the initial steps, without unit
        held : `moving` and `base` of the score
        """
        sigma = size * np.repeat((*STEP_SIGMAS,), (3, 3, len(state.angles)))[dofs]
        bounds = bounds_of(self.body, True)
        best = float(self.score(state.T_world_root[None], state.angles[None], drawn, **held)[0])
        for _ in range(rounds):
            delta = np.zeros((count, 6 + len(state.angles)))
            selected = self.rng.random((count, len(dofs))) < np.where(np.arange(count) % 2, 1.0, 0.5)[:, None]
            delta[:, dofs] = self.rng.normal(size=selected.shape) * sigma * selected
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
        """The best poses of one limb with everything else fixed, and their scores.

        Candidates are random poses, and poses that bring the tip or fist to an end of the surface. The best of either
        kind are refined: random poses may be hidden behind the trunk, which contradicts nothing. A rough search (fewer
        than `LIMB_TRIES`) has no closest-point fit.

        Parameters
        ----------
        limb : its segments
        drawn : segments that are rendered; None: all
        ends : (E, 3) [m], see `ends`
        count : number of random poses
        """
        tree = self.body.tree
        dofs = self._dofs_of(limb, False)
        d = dofs - 6
        low, high = np.maximum(tree.lower[d], -np.pi), np.minimum(tree.upper[d], np.pi)
        anywhere = self.rng.uniform(low, high, size=(count, len(d)))
        near_mean = self.rng.normal(tree.usual[d], np.minimum(prior_sigmas(self.body)[d], 0.6), size=(count, len(d)))
        angles = np.repeat(state.angles[None], 1 + count, axis=0)
        angles[1:, d] = np.clip(np.where(self.rng.random((count, 1)) < 0.35, near_mean, anywhere), low, high)
        angles = np.concatenate([angles, self._reaching(state, limb, np.tile(ends, (REACHING_STARTS, 1)))])
        drawn = tuple(range(len(tree.segments))) if drawn is None else drawn
        other_segments = tuple(s for s in drawn if s not in limb)
        held: dict[str, Any] = {"moving": limb, "base": self.score.depth(state, other_segments)}
        values = self.score(np.repeat(state.T_world_root[None], len(angles), axis=0), angles, drawn, **held)
        reaching = np.arange(len(angles)) > count
        best = [
            BodyState(state.T_world_root, angles[k])
            for kind in (np.flatnonzero(~reaching), np.flatnonzero(reaching))
            for k in kind[np.argsort(-values[kind])[:LIMB_CANDIDATES]]
        ]
        rough = sorted((self.polish(s, drawn, dofs, 3, 24, **held) for s in best), key=lambda b: -b[1])
        locked = np.ones(tree.n_dofs, bool)
        locked[dofs] = False
        fitted = [self.closest(s, 8, locked=locked) for s, _ in rough[:2]] if count >= LIMB_TRIES else []
        out = [*rough, *(self.polish(s, drawn, dofs, 3, 24, 0.4, **held) for s in fitted)]
        return sorted(out, key=lambda b: -b[1])

    def _is_out_of_view(self, state: BodyState, limb: tuple[int, ...], drawn: tuple[int, ...]) -> bool:
        """Whether a limb is invisible in its pose, and nothing unexplained is within its reach."""
        view = self.view
        if ((self.score.depth(state, limb) < view.behind) & (view.trust > 0)).sum() > _MIN_LIMB_PIXELS:
            return False
        explained = np.abs(self.score.depth(state, drawn) - view.observed) < MAX_DEPTH_ERROR
        near = self.within_reach(state, limb, view.points[view.seen & ~explained])
        return bool(near.sum() < _MIN_UNEXPLAINED * self.score.pixels)

    def within_reach(self, state: BodyState, limb: tuple[int, ...], x_world: NDArray) -> NDArray:
        """(N,) bool: which points (N, 3) [m] a limb can reach."""
        tree, mesh = self.body.tree, self.score.mesh
        frames, _ = tree.forward(state.T_world_root, state.angles)
        root = tree.rest[limb[0]] @ frames[limb[0], :9].reshape(3, 3).T + frames[limb[0], 9:]
        limb_points = mesh.vertices[np.isin(mesh.segment, limb)] - tree.rest[limb[0]]
        return np.asarray(np.linalg.norm(x_world - root, axis=1) < np.linalg.norm(limb_points, axis=1).max(initial=0.0))

    @cached_property
    def _tips(self) -> dict[int, NDArray]:
        """Far end (2, 3) [m] of each limb's last segment, stretched and as a fist, in that segment's frame."""
        out, tree, mesh, folded = {}, self.body.tree, self.score.mesh, knuckles(self.body)
        for limb in self.limbs:
            x = mesh.vertices[mesh.segment == limb[-1]] - tree.rest[limb[-1]]
            far = np.linalg.norm(x, axis=1)
            tip = x[far > 0.95 * far.max()].mean(axis=0) if len(x) else np.zeros(3)
            out[limb[-1]] = np.stack([tip, folded.get(limb[-1], tip)])
        return out

    def _reaching(self, state: BodyState, limb: tuple[int, ...], ends: NDArray) -> NDArray:
        """(2 E, D) angles that bring a limb's tip and fist to ends (E, 3) [m] of the surface, from random poses."""
        tree, d = self.body.tree, self._dofs_of(limb, False) - 6
        sight = (ends - self.view.viewpoint) / np.linalg.norm(ends - self.view.viewpoint, axis=1, keepdims=True)
        targets = np.tile(ends + 0.03 * sight, (2, 1))  # [m] the tip is half a wrist behind the measured surface
        tips = np.repeat(self._tips[limb[-1]] + tree.rest[limb[-1]], len(ends), axis=0)
        angles = np.repeat(state.angles[None], len(targets), axis=0)
        random_angles = self.rng.normal(tree.usual[d], 0.5, size=(len(targets), len(d)))
        angles[:, d] = np.clip(random_angles, tree.lower[d], tree.upper[d])
        reach_for(
            tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, state.T_world_root, angles, d, limb[-1],
            tips, targets, tree.usual, prior_sigmas(self.body), tree.lower, tree.upper, 0.03, 10,
        )  # fmt: skip
        return angles

    def ends(self, state: BodyState) -> NDArray:
        """(E, 3) [m] geodesic ends of the person's surface, from the middle of the trunk."""
        mesh = self.score.mesh
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        x = mesh.posed(frames)[np.isin(mesh.segment, self.score.trunk)]
        return geodesic_ends(self.view, x.mean(axis=0) if len(x) else state.T_world_root[:3, 3])

    def closest(
        self, state: BodyState, iterations: int = 12, first: float = 0.15, locked: NDArray | None = None
    ) -> BodyState:
        """Fit the surface to measured points by iterated closest points (point to plane, robust, within limits).

        Parameters
        ----------
        first : [m] first bound of correspondences
        locked : (6 + D,) bool, fixed degrees of freedom; None: none
        """
        body, bound = self.body, first
        sigma = 2.0 * prior_sigmas(body)
        for _ in range(iterations):
            rows = surface_rows(body, state, self.points, max_distance=bound, sigma=0.02, viewpoint=self.view.viewpoint)
            parts: list[AnyRows] = [rows, prior_rows(body, state, sigma=sigma)]
            damping = 30.0 * max(len(rows), 1)  # 1 % of a row's weight: parts seen from one side stay
            state = gauss_newton(body, state, parts, loss=geman_mcclure(2.0), damping=damping, locked=locked).state
            bound = max(0.8 * bound, 0.06)
        return state

    def best(self, count: int) -> list[BodyState]:
        """At most `count` postures, the best first."""
        found = []
        for state in self.trunks(8):
            ends, drawn = self.ends(state), self.score.core
            for limb in self.limbs:
                drawn = (*drawn, *limb)
                if not self._is_out_of_view(state, limb, drawn):
                    state = self.limb(state, limb, drawn, ends, ROUGH_LIMB_TRIES)[0][0]
            found.append((self.value(state), state, ends))
        found.sort(key=lambda f: -f[0])
        refined_states = [(self.refined(state, ends, 1), ends) for _, state, ends in found[:3]]
        refined_states.sort(key=lambda f: -self.value(f[0]))
        out = [self.refined(state, ends, 1) if k < 1 else state for k, (state, ends) in enumerate(refined_states)]
        return sorted(out, key=lambda s: -self.value(s))[:count]

    def refined(self, state: BodyState, ends: NDArray, rounds: int = 2) -> BodyState:
        """Refine a posture: closest points, a new search of each limb, random steps of everything; ends (E, 3) [m]."""
        everything, everything_drawn = np.arange(self.body.tree.n_dofs), tuple(range(len(self.body.tree.segments)))
        for _ in range(rounds):
            state = max(state, self.closest(state), key=self.value)
            for limb in self.limbs:
                if not self._is_out_of_view(state, limb, everything_drawn):
                    state = self.limb(state, limb, None, ends, LIMB_TRIES)[0][0]
            state, _ = self.polish(state, None, everything, 10, 40, 0.4)
        closer = self.closest(state, first=0.10)
        return closer if self.value(closer) > self.value(state) - 0.02 else state  # points are finer than pixels


def _distinct(roots: NDArray, values: NDArray, count: int) -> list[int]:
    """Indices of the best poses that differ by 10 cm or 25 degrees from all better ones."""
    out: list[int] = []
    min_trace = 1.0 + 2.0 * np.cos(np.radians(25.0))  # trace of a rotation
    for k in np.argsort(-values):
        R, t = roots[k, :3, :3], roots[k, :3, 3]
        if all(np.linalg.norm(t - roots[m, :3, 3]) > 0.10 or np.sum(R * roots[m, :3, :3]) < min_trace for m in out):
            out.append(int(k))
        if len(out) == count:
            break
    return out
