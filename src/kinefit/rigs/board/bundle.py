"""Bundle adjustment of cameras and a board at a new pose in every frame (Triggs et al., 1999, with Schur).

Cameras are seldom exactly synchronised, and a hand-held board moves. So in each view the board may be slightly off its
pose in the frame: x_camera = T_camera_world T_world_board exp(η) x_board, with η ~ N(0, Σ) for each view. Σ (a variance
of shift and one of turn) is estimated. η is eliminated from each view's equations first. So the shape of a board within
one image constrains the lens with full weight, and the relation between images counts less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import huber
from kinefit.solving.bundle.adjust import Bundle, BundleProblem, BundleState, adjust
from kinefit.solving.bundle.arrow import Arrow, assembled
from kinefit.solving.bundle.cameras import ASPECT, CENTRE, COLUMNS, DISTORTION, FOCAL, POSE, CameraPrior, pixel_rows

_LOSS = huber(1.345)  # 95 % efficient for normal errors (Huber, 1981)
_CORNER_SIGMA_PX = 0.25  # along one axis, in sharp to slightly blurred images
_INITIAL_JITTER = (3e-3, 6e-3)  # [m, rad] of a hand-held board and cameras some milliseconds apart
_MIN_JITTER = (1e-5, 2e-5)  # [m, rad] no board is flatter


@dataclass(frozen=True, eq=False)
class Corners:
    """M detected corners.

    Parameters
    ----------
    camera, frame : (M,) int, indices in the rig and in the stack of board poses.
    x_board : (M, 3) [m]
    uv : (M, 2) [px]
    """

    camera: NDArray
    frame: NDArray
    x_board: NDArray
    uv: NDArray

    def in_world(self, Ts_world_board: NDArray) -> NDArray:
        """(M, 3) [m] the corners on boards at poses (F, 4, 4)."""
        return se3.apply(Ts_world_board[self.frame], self.x_board)


@dataclass(frozen=True, eq=False)
class BoardBundle:
    """Adjusted cameras and board poses.

    Parameters
    ----------
    rig : Rig
    Ts_world_board : (F, 4, 4) [m]
    residuals : (M, 2) [px] measured minus projected, with the board at its pose in the frame.
    within : (M, 2) [px] the same with the board at its pose in the view.
    jitter : (shift [m], turn [rad]) standard deviations of the board in a view about its pose in the frame.
    position_std : (C,) [m] of each camera's centre, relative to the first; NaN if undetermined.
    focal_std : (C,) [px], zero for known intrinsics.
    """

    rig: Rig
    Ts_world_board: NDArray
    residuals: NDArray
    within: NDArray
    jitter: tuple[float, float]
    position_std: NDArray
    focal_std: NDArray


def adjust_boards(
    rig: Rig, Ts_world_board: NDArray, corners: Corners, *, interiors: bool, max_iterations: int = 40, rounds: int = 6
) -> BoardBundle:
    """Minimise the robust pixel error over cameras and board poses; the first camera stays fixed.

    Parameters
    ----------
    Ts_world_board : (F, 4, 4) [m] start
    corners : Corners
        Corners of one view consecutive.
    interiors : bool
        Whether focal lengths, centres and distortion change too (lens model "radtan" only).
    rounds : int
        Largest number of estimates of Σ (by expectation maximisation), each with a solve.
    """
    prior, problem = _free(rig, interiors), BoardProblem(corners, _INITIAL_JITTER)
    state = BundleState(rig, np.zeros(len(rig)), Ts_world_board)
    for _ in range(rounds):
        found = adjust(state, prior, problem, iterations=max_iterations, tolerance=1e-6)
        state, before, problem = found.state, problem.jitter, replace(problem, jitter=problem.jitter_of(found))
        if all(abs(new / old - 1) < 0.05 for new, old in zip(problem.jitter, before)):
            break
    found, std = adjust(state, prior, problem, iterations=0), np.zeros(prior.sigma.shape)
    std[prior.free] = np.sqrt(np.diag(found.posterior.covariances()[0]))
    residuals = corners.uv - state.rig.project(corners.in_world(state.blocks), corners.camera)
    position_std, focal = np.linalg.norm(std[:, :3], axis=1), np.array([camera.matrix[0, 0] for camera in state.rig])
    return BoardBundle(
        state.rig, state.blocks, residuals, found.detail[0], problem.jitter, position_std, focal * std[:, FOCAL]
    )


def _free(rig: Rig, interiors: bool) -> CameraPrior:
    """No prior of the cameras, the first one's pose fixed."""
    sigma = np.zeros((len(rig), COLUMNS))
    sigma[1:, POSE] = np.inf
    if interiors:
        sigma[:, [FOCAL, ASPECT]] = sigma[:, CENTRE] = np.inf
        for own, camera in zip(sigma[:, DISTORTION], rig):
            own[: camera.distortion.size] = np.inf
    return CameraPrior(rig, sigma)


@dataclass(frozen=True, eq=False)
class BoardProblem(BundleProblem):
    """Corners of boards at poses (F, 4, 4), the blocks; views are runs of corners of one camera and frame.

    Parameters
    ----------
    corners : Corners
    jitter : (shift [m], turn [rad]) standard deviations of η
    """

    corners: Corners
    jitter: tuple[float, float]

    @cached_property
    def precision(self) -> NDArray:
        """(6,) of η."""
        return np.repeat(1.0 / np.square(self.jitter), 3)

    @cached_property
    def starts(self) -> NDArray:
        """(V,) first corner of each view."""
        change = np.diff(self.corners.camera) | np.diff(self.corners.frame)
        return np.concatenate([[0], np.flatnonzero(change) + 1])

    def moved(self, state: BundleState, delta: NDArray, moves: Sequence[NDArray]) -> BundleState:
        """The state with moved boards."""
        return replace(state, blocks=state.blocks @ se3.exp(moves[0]))

    def jitter_of(self, found: Bundle) -> tuple[float, float]:
        """Standard deviations (shift, turn) of η over the views of frames shared by two or more cameras."""
        frame = self.corners.frame[self.starts]
        count = np.bincount(frame)[frame]
        if not (count > 1).any():
            return _MIN_JITTER
        # The frame's pose absorbs one view's freedom. Medians: a wrong view must not weaken all others.
        square = found.detail[1] ** 2 + found.detail[2]
        second = square[count > 1] * (count / np.maximum(count - 1, 1))[count > 1, None]
        shift, turn = (float(np.sqrt(np.median(second[:, part].mean(axis=1)))) for part in (slice(0, 3), slice(3, 6)))
        return max(shift, _MIN_JITTER[0]), max(turn, _MIN_JITTER[1])

    def linearised(self, state: BundleState, prior: CameraPrior) -> tuple[Arrow, float, tuple[NDArray, ...]]:
        """Equations, η of each view eliminated; cost; residuals (M, 2) [px] at the best η, η (V, 6), its variances."""
        corners, starts, Ts, board = self.corners, self.starts, state.blocks, slice(-7, -1)
        R = Ts[corners.frame, :3, :3]
        by_board = np.concatenate([R, -R @ se3.hat(corners.x_board)], axis=2)
        rows = pixel_rows(state.rig, prior, corners.camera, corners.in_world(Ts), corners.uv, by_block=by_board)
        rows[~np.isfinite(rows[..., -1]).all(axis=1)] = 0.0
        counts = np.diff([*starts, len(rows)])
        of_view = np.repeat(np.arange(len(starts)), counts), np.arange(len(rows)) - np.repeat(starts, counts)
        G, w = np.zeros((len(starts), counts.max(), *rows.shape[1:])), np.ones((len(starts), counts.max()))
        G[of_view] = rows  # views of few corners end with zeros
        flat = G.reshape(len(G), -1, G.shape[3])
        for _ in range(2):
            M = flat.swapaxes(1, 2) @ ((w / _CORNER_SIGMA_PX**2).repeat(2, axis=1)[..., None] * flat)
            inverse = np.linalg.inv(M[:, board, board] + np.diag(self.precision))
            eta = inverse @ M[:, board, -1:]
            residuals = G[..., -1] - (flat[..., board] @ eta).reshape(G.shape[:3])
            rho, w = _LOSS.weigh(np.sum(residuals**2, axis=2) / _CORNER_SIGMA_PX**2)
        M -= M[:, :, board] @ inverse @ M[:, board]
        cost = float(rho.sum() + np.sum(eta[..., 0] ** 2 @ self.precision))
        arrow = assembled(M, corners.camera[starts], corners.frame[starts], prior.free, len(Ts))
        return arrow, cost, (residuals[of_view], eta[..., 0], np.einsum("vii->vi", inverse))
