"""Normal equations in the shape of an arrow: blocks of unknowns, each coupled to itself and to shared parameters alone.

Poses of frames, rigid motions and free points are blocks; cameras, lengths, lenses and clocks are shared. Eliminating
the blocks (Schur complement, B. Triggs et al., Bundle Adjustment - A Modern Synthesis, 1999) leaves equations of the
shared parameters, so the work grows linearly with the blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

MIN_DIAGONAL_RATIO = 1e-9
"""To a block's mean diagonal: what is added to its diagonal, for unmeasured directions."""

_UNMEASURED_RATIO = 0.01  # the same, times the damping: with less, hardly measured angles make steps fail


@dataclass(frozen=True, eq=False)
class Blocks:
    """F blocks of n unknowns: equations H (F, n, n), g (F, n), and coupling B (F, n, p) to the p shared parameters."""

    H: NDArray
    g: NDArray
    B: NDArray


@dataclass(frozen=True, eq=False)
class Arrow:
    """Equations of p shared parameters, H (p, p) and g (p,), and of blocks of one size or several.

    Damping is what is added to diagonals: (p,) and, for each kind of blocks, (F, n).
    """

    H: NDArray
    g: NDArray
    blocks: tuple[Blocks, ...]

    def with_prior(self, information: NDArray, pull: NDArray) -> Arrow:
        """The same with a prior of the parameters: information (p, p) or its diagonal (p,), and gradient (p,)."""
        more = np.diag(information) if information.ndim == 1 else information
        return replace(self, H=self.H + more, g=self.g + pull)

    def holding(self, held: NDArray) -> Arrow:
        """The same with some unknowns (F, n) bool of the first blocks at rest."""
        first, free = self.blocks[0], ~held
        H = np.where(free[:, :, None] & free[:, None, :], first.H, 0.0)
        H[held[:, :, None] & np.eye(held.shape[1], dtype=bool)] = 1.0
        return replace(self, blocks=(Blocks(H, free * first.g, free[..., None] * first.B), *self.blocks[1:]))

    def relative(self, damping: float) -> tuple[NDArray, list[NDArray]]:
        """Damping by a share of the diagonals themselves."""
        own = [np.einsum("fii->fi", blocks.H) for blocks in self.blocks]
        within = [damping * (d + _UNMEASURED_RATIO * d.mean(axis=1, keepdims=True)) for d in own]
        return damping * np.diag(self.H), within

    def reduced(self, border: NDArray, within: Sequence[NDArray]) -> tuple[NDArray, NDArray, list[NDArray]]:
        """Schur complement (p, p), (p,), and for each kind of blocks (F, n, p + 1): H⁻¹ [B, g]."""
        S, b, backs = self.H + np.diag(border), self.g, []
        for blocks, more in zip(self.blocks, within, strict=True):
            H, p, n = blocks.H.copy(), len(b), blocks.g.shape[1]
            diagonal = np.einsum("fii->fi", H)
            diagonal += more + MIN_DIAGONAL_RATIO * diagonal.mean(axis=1, keepdims=True) + 1e-12
            back = np.linalg.solve(H, np.concatenate([blocks.B, blocks.g[..., None]], axis=2))
            both = blocks.B.reshape(-1, p).T @ back.reshape(-1, p + 1)
            S, b = S - both[:, :p], b - both[:, p]
            backs.append(back.reshape(-1, n, p + 1))
        return S, b, backs

    def step(self, border: NDArray, within: Sequence[NDArray]) -> tuple[tuple[NDArray, list[NDArray]], float]:
        """Steps of the parameters (p,) and of each kind of blocks (F, n), and the predicted fall of the cost."""
        S, b, backs = self.reduced(border, within)
        scale = _scale(S)
        delta = scale * np.linalg.solve(S * np.outer(scale, scale) + 1e-14 * np.eye(len(S)), scale * b)
        moves = [back[..., -1] - back[..., :-1] @ delta for back in backs]
        fall = float(delta @ (self.g + border * delta))
        for blocks, more, move in zip(self.blocks, within, moves, strict=True):
            fall += float(np.vdot(move, blocks.g + more * move))
        return (delta, moves), fall

    def relative_step(self, damping: float) -> tuple[tuple[NDArray, list[NDArray]], float]:
        """A step damped by a share of the diagonals themselves."""
        return self.step(*self.relative(damping))

    def covariances(self) -> tuple[NDArray, list[NDArray]]:
        """Covariances of the parameters (p, p), and of each kind of blocks (F, n, n)."""
        S, _, backs = self.reduced(*self.relative(0.0))
        scale = _scale(S)
        cov, out = np.linalg.pinv(S * np.outer(scale, scale), hermitian=True, rcond=1e-15) * np.outer(scale, scale), []
        for blocks, back in zip(self.blocks, backs, strict=True):
            gain = back[..., :-1]
            out.append(np.linalg.inv(blocks.H) + gain @ cov @ np.swapaxes(gain, 1, 2))
        return cov, out


def _scale(S: NDArray) -> NDArray:
    """(p,) factors that make the diagonal of S (p, p) one: units differ by many orders of magnitude."""
    return 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))


def assembled(grams: NDArray, camera: NDArray, block: NDArray, free: NDArray, blocks: int) -> Arrow:
    """The arrow of the free parameters of C cameras, and of F blocks of n unknowns.

    Parameters
    ----------
    grams : (K, P + n + 1, P + n + 1) products Aᵀ W A, A = [derivatives by the camera, by the block, residual], with
        the P parameters that are free in one camera or more
    camera, block : (K,) int, of each product
    free : (C, N) bool, of all parameters
    """
    free = free[:, free.any(axis=0)]
    (C, P), F, size = free.shape, blocks, grams.shape[1] - free.shape[1] - 1
    H, g, own = np.zeros((C, P, C, P)), _summed(grams[:, :P, -1], camera, C), free.ravel()
    H[range(C), :, range(C)] = _summed(grams[:, :P, :P], camera, C)
    B = _summed(grams[:, P:-1, :P], block * C + camera, F * C).reshape(F, C, size, P).swapaxes(1, 2)
    of_blocks = Blocks(
        _summed(grams[:, P:-1, P:-1], block, F), _summed(grams[:, P:-1, -1], block, F),
        B.reshape(F, size, C * P)[..., own],
    )  # fmt: skip
    return Arrow(H.reshape(C * P, C * P)[np.ix_(own, own)], g.ravel()[own], (of_blocks,))


def _summed(values: NDArray, group: NDArray, groups: int) -> NDArray:
    """(G, ...) sums of values (K, ...) by group (K,)."""
    from scipy.sparse import csr_array

    K, shape = len(values), values.shape[1:]
    chosen = csr_array((np.ones(K), (group, np.arange(K))), shape=(groups, K))
    return np.asarray(chosen @ values.reshape(K, int(np.prod(shape)))).reshape(groups, *shape)
