"""Eliminate surface offsets: the error of the body's surface relative to the bone is a nuisance parameter.

The error of a model's surface and soft tissue displaces all rows of a segment alike, in every sensor that measures
surfaces and over the whole take. It bounds how well surfaces determine a segment's pose, whatever the number of rows.
Let the segment's surface be shifted and turned by an unknown e ~ N(0, Σ). Eliminating e turns the normal equations
(H, g) of the segment's rows into

    H' = H − H (H + Σ⁻¹)⁻¹ H,        g' = Σ⁻¹ (H + Σ⁻¹)⁻¹ g

Points of a skin that blends or morphs do not move with their segment alone: their derivatives J by the pose are no
function of the segment's twist. Those by the offset are, A = (n, x × n). They are the root's columns of J: a turn
of the whole body turns every point. With whitened rows, and A by standard deviations of e, eliminating e whitens again:

    W' = I − A (AᵀA + I)⁻¹ Aᵀ = (I − U (1 − (1 + S²)^-½) Uᵀ)²,        A = U S Vᵀ
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.surfaces import segment_middles
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.sensors.base import Matched
from kinefit.sensors.scene import Scene
from kinefit.solving import _kernels
from kinefit.solving.correspondences.contours.outlines import on_moved_joints
from kinefit.solving.equations import robust_factors
from kinefit.solving.rows import AnyRows, DofRows, Rows

_MIN_EIGENVALUE_RATIO = 1e-9  # to the segment's largest: a direction below it is not observed


@dataclass(frozen=True, eq=False)
class Skin:
    """Normal equations of S segments' surfaces, each about its middle, with the surface offset eliminated.

    Parameters
    ----------
    H, g : (S, 6, 6), (S, 6) of twists (v at the middle, ω)
    jacobian : (S, 6, n) of those twists by the degrees of freedom
    sigma : (6,) [m, rad] standard deviations of the surface offset
    exact : (S, 6, 6) H of surfaces that count as exact, nothing eliminated
    turned : (S, 6) one standard deviation of the additional twist of the anchors of tracked surface points
    """

    H: NDArray
    g: NDArray
    jacobian: NDArray
    sigma: NDArray
    exact: NDArray
    turned: NDArray

    def rows(self) -> DofRows:
        """The normal equations as rows: one for each observed direction of a segment, six at most."""
        values, vectors = np.linalg.eigh(self.H)
        s, k = np.nonzero(values > _MIN_EIGENVALUE_RATIO * np.maximum(values[:, -1:], 1e-12))
        v, w = vectors[s, :, k], values[s, k]
        residual = np.einsum("ri,ri->r", v, self.g[s]) / w
        J = np.einsum("ri,rin->rn", v, self.jacobian[s])
        return DofRows(J, residual, w, np.full(len(w), -1))

    @property
    def information(self) -> NDArray:
        """Information (n, n) of the degrees of freedom, Jᵀ H' J."""
        return self.jacobian.reshape(-1, self.n).T @ (self.H @ self.jacobian).reshape(-1, self.n)

    @property
    def exact_information(self) -> NDArray:
        """Information (n, n) where surfaces count as exact, Jᵀ H J."""
        return self.jacobian.reshape(-1, self.n).T @ (self.exact @ self.jacobian).reshape(-1, self.n)

    @property
    def pushes(self) -> NDArray:
        """(7 S, n) gradient of the degrees of freedom by one standard deviation of each surface offset."""
        return self._pushes(self.H)

    @property
    def exact_pushes(self) -> NDArray:
        """(7 S, n) the same where surfaces count as exact."""
        return self._pushes(self.exact)

    def _pushes(self, H: NDArray) -> NDArray:
        by_twist = H @ self.jacobian
        anchored = np.einsum("si,sin->sn", self.turned, by_twist)
        return np.concatenate([(self.sigma[:, None] * by_twist).reshape(-1, self.n), anchored])

    @property
    def n(self) -> int:
        """Number of degrees of freedom."""
        return int(self.jacobian.shape[2])


@dataclass(frozen=True, eq=False)
class BlendedSkin:
    """Rows of surfaces that blend or morph, with the surface offsets of their segments: the same as `Skin` of them.

    Parameters
    ----------
    J, residual : (N, n), (N,) whitened rows
    offset : (N, 7) their derivatives by one standard deviation of the segment's surface offset, about its middle, and
        of the additional twist of the anchors of tracked surface points
    segment : (N,) int
    """

    J: NDArray
    residual: NDArray
    offset: NDArray
    segment: NDArray

    @cached_property
    def _eliminated(self) -> BlendedSkin:
        J, residual, offset = (np.array(values) for values in (self.J, self.residual, self.offset))
        for s in np.unique(self.segment):
            own = self.segment == s
            U, scale, _ = np.linalg.svd(self.offset[own, :6], full_matrices=False)
            U_less = U * (1.0 - 1.0 / np.sqrt(1.0 + scale**2))
            for values in (J, residual, offset):
                values[own] -= U_less @ (U.T @ values[own])
        return BlendedSkin(J, residual, offset, self.segment)

    def rows(self) -> DofRows:
        """The rows with surface offsets eliminated, as n rows at most."""
        found, n = self._eliminated, self.J.shape[1]
        R = np.asarray(np.linalg.qr(np.column_stack([found.J, found.residual]), mode="r"))[:n]
        return DofRows(R[:, :n], R[:, n], np.ones(len(R)), np.full(len(R), -1))

    @property
    def information(self) -> NDArray:
        """Information (n, n) of the degrees of freedom, surface offsets eliminated."""
        return self._eliminated.exact_information

    @property
    def exact_information(self) -> NDArray:
        """Information (n, n) where surfaces count as exact."""
        return self.J.T @ self.J

    @property
    def pushes(self) -> NDArray:
        """(7 S, n) gradient of the degrees of freedom by one standard deviation of each surface offset."""
        return self._eliminated.exact_pushes

    @property
    def exact_pushes(self) -> NDArray:
        """(7 S, n) the same where surfaces count as exact."""
        of = (self.segment == s for s in np.unique(self.segment))
        return np.concatenate([self.offset[own].T @ self.J[own] for own in of])


def has_surface_offset(rows: AnyRows, matched: Matched) -> TypeGuard[Rows | DofRows]:
    """Whether rows of a match are of a surface, each on one segment, whose surface offset they share."""
    return not matched.of_points and isinstance(rows, Rows | DofRows) and rows.segment is not None


def skin_of(
    scene: Scene, parts: Sequence[Rows | DofRows], shift: float, turn: float, matched: Sequence[Matched] = ()
) -> Skin | BlendedSkin:
    """Normal equations of the surface rows of all sensors at a scene's state, surface offsets eliminated.

    Parameters
    ----------
    parts : surface rows with their losses
    shift, turn : [m], [rad] standard deviations of a segment's surface offset
    matched : matches, whose `turns` are additional constant offsets
    """
    body, tree = scene.body, scene.body.tree
    S = len(tree.segments)
    R = scene.frames[:, :9].reshape(S, 3, 3)
    middle = np.einsum("sij,sj->si", R, _middles(body)) + scene.frames[:, 9:]
    sigma, turned = np.array([shift] * 3 + [turn] * 3), np.zeros((S, 6))
    for s, by in (pair for m in matched for pair in m.turns.items()):
        if by @ by > turned[s] @ turned[s]:
            turned[s, 3:] = R[s] @ by
    plain = [part for part in parts if isinstance(part, Rows)]
    if len(plain) < len(parts):
        dense = [on_moved_joints(scene.pose, part) if isinstance(part, Rows) else part for part in parts]
        return _blended(scene, dense, middle, sigma, turned)
    rows = Rows.concat(*plain)
    factor = np.concatenate([np.zeros(0), *(robust_factors(p)[0] for p in parts)])
    data = np.array(rows.data)
    data[:3] -= middle[rows.segment].T
    blocks = np.zeros((S, 27))
    segment = rows.segment
    if np.any(segment[1:] < segment[:-1]):
        order = np.argsort(segment, kind="stable")
        data, segment, factor = np.ascontiguousarray(data[:, order]), segment[order], factor[order]
    _kernels.accumulate(data, segment, factor, len(rows), 0.0, 0.0, 0.0, blocks)
    H, upper = np.zeros((S, 6, 6)), np.triu_indices(6)
    H[:, upper[0], upper[1]] = blocks[:, :21]
    H[:, upper[1], upper[0]] = blocks[:, :21]
    g = blocks[:, 21:]
    inverse = np.diag(sigma**-2.0)
    offset = np.linalg.solve(H + inverse, np.concatenate([H, g[..., None]], axis=2))
    reduced = H - H @ offset[..., :6]
    g = inverse @ offset[..., 6:]
    return Skin(0.5 * (reduced + reduced.swapaxes(1, 2)), g[..., 0], _jacobians(scene, middle), sigma, H, turned)


def _blended(scene: Scene, parts: Sequence[DofRows], middle: NDArray, sigma: NDArray, turned: NDArray) -> BlendedSkin:
    """Whitened rows with their surface offsets about the segments' middles (S, 3) [m] in the world."""
    root = np.sqrt(np.concatenate([p.weight * robust_factors(p)[0] for p in parts]))
    J = root[:, None] * np.concatenate([p.jacobian for p in parts])
    segment = np.concatenate([p.segment for p in parts])  # type: ignore[misc]
    arm = scene.state.T_world_root[:3, 3] - middle[segment]
    twist = np.concatenate([J[:, :3], J[:, 3:6] + np.cross(arm, J[:, :3])], axis=1)
    anchored = np.sum(twist * turned[segment], axis=1)
    residual = root * np.concatenate([p.residual for p in parts])
    return BlendedSkin(J, residual, np.column_stack([twist * sigma, anchored]), segment)


def _jacobians(scene: Scene, middle: NDArray) -> NDArray:
    """(S, 6, n) derivative of each segment's twist (v at its middle, ω) by every degree of freedom."""
    body, state = scene.body, scene.state
    if scene.morphing is not None:
        pose = scene.morphing.pose(state)
        J = np.stack([pose.segment_jacobian(s) for s in range(len(middle))])
    else:
        _, screws = body.tree.forward(state.T_world_root, state.angles)
        J = np.stack([body.tree.segment_jacobian(screws, s) for s in range(len(middle))])
    arm = middle - state.T_world_root[:3, 3]
    out = np.array(J)
    out[:, :3] += np.cross(J[:, 3:].swapaxes(1, 2), arm[:, None, :]).swapaxes(1, 2)
    return out


@lru_cache(maxsize=8)
def _middles(body: Body) -> NDArray:
    """(S, 3) [m] middle of each segment's surface, in the root frame in the rest pose."""
    mesh = body_mesh(body)
    return segment_middles(mesh.vertices, mesh.segment, len(body.tree.segments))
