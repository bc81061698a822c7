"""Bundle adjustment of cameras and a board at a new pose in every frame (Triggs et al., 1999, with Schur).

Cameras are seldom exactly synchronised, and a hand-held board moves. So in each view the board may be slightly off its
pose in the frame: x_camera = T_camera_world T_world_board exp(η) x_board, with η ~ N(0, Σ) for each view. Σ (a variance
of shift and one of turn) is estimated. η is eliminated from each view's equations first. So the shape of a board within
one image constrains the lens with full weight, and the relation between images counts less.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.solvers.bundle.arrow import Arrow, assembled
from kinefit.solvers.least_squares import descend

_POSE = 6  # parameters of a pose
_HUBER_SIGMAS = 1.345  # 95 % efficient for normal errors (Huber, 1981)
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

    def only(self, keep: NDArray) -> Corners:
        """The corners selected by a mask (M,) bool."""
        return Corners(self.camera[keep], self.frame[keep], self.x_board[keep], self.uv[keep])


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
    jitter = _INITIAL_JITTER
    for _ in range(rounds):
        problem = _BoardProblem(corners, interiors, jitter)
        rig, Ts_world_board = problem.solve(rig, Ts_world_board, max_iterations)
        before, jitter = jitter, problem.jitter_of(rig, Ts_world_board)
        if all(abs(new / old - 1) < 0.05 for new, old in zip(jitter, before)):
            break
    problem = _BoardProblem(corners, interiors, jitter)
    system = problem.system(rig, Ts_world_board)
    position_std, focal_std = _deviations(system, len(rig))
    left = residuals(rig, Ts_world_board, corners)
    return BoardBundle(rig, Ts_world_board, left, system.within, jitter, position_std, focal_std)


def residuals(rig: Rig, Ts_world_board: NDArray, corners: Corners) -> NDArray:
    """(M, 2) [px] measured minus projected; NaN behind a camera."""
    T = Ts_world_board[corners.frame]
    x_world = (T[:, :3, :3] @ corners.x_board[..., None])[..., 0] + T[:, :3, 3]
    projected = np.empty(corners.uv.shape)
    for c, camera in enumerate(rig):
        own = corners.camera == c
        projected[own] = camera.project(x_world[own])
    return corners.uv - projected


def interior_parameters(camera: Camera) -> int:
    """Number of intrinsic parameters: fx, fy, cx, cy and the distortion."""
    return 4 + camera.distortion.size


def moved_camera(camera: Camera, delta: NDArray, interiors: bool) -> Camera:
    """The camera changed by delta (6 + P,): a twist in its frame, then intrinsic parameters."""
    T = se3.exp(delta[:_POSE]) @ camera.T_camera_world
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])
    if not interiors:
        return camera.with_pose(T)
    d, K = delta[_POSE : _POSE + interior_parameters(camera)], np.array(camera.matrix)
    K[[0, 1, 0, 1], [0, 1, 2, 2]] += d[:4]
    return replace(camera, matrix=K, distortion=camera.distortion + d[4:], T_camera_world=T)


def moved_rig(rig: Rig, delta: NDArray, interiors: bool) -> Rig:
    """All cameras changed by delta (C · (6 + P),)."""
    parts = zip(rig, delta.reshape(len(rig), -1))
    return Rig(tuple(moved_camera(camera, d, interiors) for camera, d in parts))


def pixel_columns(camera: Camera, x_camera: NDArray, interiors: bool) -> tuple[NDArray, NDArray, NDArray]:
    """Pixels (M, 2), their derivatives by the point in the camera's frame (M, 2, 3) and by the interior (M, 2, P)."""
    if not interiors:
        at_origin = camera.with_pose(np.eye(4))
        uv, J = at_origin.project_with_jacobian(x_camera)
        return uv, J, np.zeros((len(x_camera), 2, 0))
    k = camera.distortion if camera.distortion.size else np.zeros(4)
    uv, jacobian = cv2.projectPoints(x_camera, np.zeros(3), np.zeros(3), camera.matrix, k)
    J = jacobian.reshape(len(x_camera), 2, -1)
    return uv.reshape(-1, 2), J[..., 3:6], J[..., 6 : 6 + interior_parameters(camera)]


@dataclass(frozen=True, eq=False)
class CameraEquations:
    """Cameras, the unknowns of blocks, their arrow and cost; free: (n,) bool, the cameras' parameters that move."""

    rig: Rig
    unknowns: NDArray
    arrow: Arrow
    free: NDArray
    cost: float

    def covariances(self) -> tuple[NDArray, NDArray]:
        """Covariances (N, N) of the cameras, zero for fixed parameters, and (F, 6, 6) of the frames' unknowns."""
        cov, (blocks,) = self.arrow.covariances()
        return np.where(np.outer(self.free, self.free), cov, 0.0), blocks


@dataclass(frozen=True, eq=False)
class _BoardEquations(CameraEquations):
    within: NDArray
    eta: NDArray  # (V, 6)
    spread: NDArray  # (V, 6) variances of η


class _BoardProblem:
    """The corners, the free parameters, and Σ; views are runs of corners of one camera and frame."""

    def __init__(self, corners: Corners, interiors: bool, jitter: tuple[float, float]) -> None:
        self.corners, self.interiors = corners, interiors
        self.precision = np.repeat(1.0 / np.square(jitter), 3)
        change = np.flatnonzero(np.diff(corners.camera) | np.diff(corners.frame)) + 1
        starts = np.concatenate([[0], change])
        self.views = list(zip(starts, np.append(change, len(corners.camera))))
        self.camera, self.frame = corners.camera[starts], corners.frame[starts]
        self.sigma = _CORNER_SIGMA_PX

    def solve(self, rig: Rig, Ts_world_board: NDArray, max_iterations: int) -> tuple[Rig, NDArray]:
        """Minimise the cost by damped Gauss-Newton."""

        def follow(at: _BoardEquations, move: tuple[NDArray, list[NDArray]]) -> _BoardEquations:
            boards = np.stack([T @ se3.exp(d) for T, d in zip(at.unknowns, move[1][0])])
            return self.system(moved_rig(at.rig, move[0], self.interiors), boards)

        end = descend(
            self.system(rig, Ts_world_board), lambda at, damping: at.arrow.relative_step(damping), follow,
            iterations=max_iterations, damping=1e-3, tolerance=1e-6,
        ).at  # fmt: skip
        return end.rig, end.unknowns

    def jitter_of(self, rig: Rig, Ts_world_board: NDArray) -> tuple[float, float]:
        """Standard deviations (shift, turn) of η over the views of frames shared by two or more cameras."""
        system = self.system(rig, Ts_world_board)
        count = np.bincount(self.frame, minlength=len(Ts_world_board))[self.frame]
        if not (count > 1).any():
            return _MIN_JITTER
        # The frame's pose absorbs one view's freedom. Medians: a wrong view must not weaken all others.
        second = (system.eta**2 + system.spread)[count > 1] * (count / np.maximum(count - 1, 1))[count > 1, None]
        shift, turn = (float(np.sqrt(np.median(second[:, part].mean(axis=1)))) for part in (slice(0, 3), slice(3, 6)))
        return max(shift, _MIN_JITTER[0]), max(turn, _MIN_JITTER[1])

    def system(self, rig: Rig, Ts: NDArray) -> _BoardEquations:
        """Linearise at a rig and board poses (F, 4, 4)."""
        corners, C, F, V = self.corners, len(rig), len(Ts), len(self.views)
        P = _POSE + max(interior_parameters(camera) for camera in rig) * self.interiors
        free = np.zeros((C, P), bool)
        free[1:, :_POSE] = True
        G = np.zeros((len(corners.uv), 2, P + 7))  # camera, board, residual
        for c, camera in enumerate(rig):
            own = corners.camera == c
            x_board, T = corners.x_board[own], camera.T_camera_world @ Ts[corners.frame[own]]
            x = (T[:, :3, :3] @ x_board[..., None])[..., 0] + T[:, :3, 3]
            uv, J, J_interior = pixel_columns(camera, x, self.interiors)
            free[c, _POSE : _POSE + J_interior.shape[2]] = True
            JR, part = J @ T[:, :3, :3], np.zeros((len(x), 2, P + 7))
            part[..., :_POSE] = np.concatenate([J, np.cross(x[:, None], J)], axis=2)
            part[..., _POSE : _POSE + J_interior.shape[2]] = J_interior
            part[..., :P] *= free[c]
            part[..., P:-1] = np.concatenate([JR, np.cross(x_board[:, None], JR)], axis=2)
            part[..., -1] = corners.uv[own] - uv
            G[own] = np.where(np.isfinite(part).all(axis=(1, 2), keepdims=True) & (x[:, 2, None, None] > 0), part, 0.0)
        grams, cost, within = np.empty((V, P + 7, P + 7)), 0.0, np.zeros(corners.uv.shape)
        eta, spread = np.zeros((V, 6)), np.zeros((V, 6))
        for v, (start, stop) in enumerate(self.views):
            grams[v], within[start:stop], eta[v], spread[v], more = self._view(G[start:stop], P)
            cost += more
        arrow = assembled(grams, self.camera, self.frame, C, F, _POSE)
        arrow = arrow.with_prior((~free.ravel()).astype(float), np.zeros(free.size))
        return _BoardEquations(rig, Ts, arrow, free.ravel(), cost, within, eta, spread)

    def _view(self, G: NDArray, P: int) -> tuple[NDArray, NDArray, NDArray, NDArray, float]:
        """One view's equations with η eliminated; its residuals at the best η, η, its variances, the cost."""
        w, board, left = np.ones(len(G)), G[..., P:-1], G[..., -1]
        for _ in range(2):
            WG = (w / self.sigma**2)[:, None, None] * G
            M = WG.reshape(-1, P + 7).T @ G.reshape(-1, P + 7)
            inverse = np.linalg.inv(M[P:-1, P:-1] + np.diag(self.precision))
            eta = inverse @ M[P:-1, -1]
            rest = left - board @ eta
            size = np.linalg.norm(rest, axis=1) / self.sigma
            w = np.minimum(1.0, _HUBER_SIGMAS / np.maximum(size, 1e-12))
        M -= M[:, P:-1] @ inverse @ M[P:-1]
        huber = np.where(size < _HUBER_SIGMAS, size**2, _HUBER_SIGMAS * (2 * size - _HUBER_SIGMAS))
        cost = np.sum(huber) + eta @ (self.precision * eta)
        return M, rest, eta, np.diag(inverse), float(cost)


def _deviations(system: _BoardEquations, cameras: int) -> tuple[NDArray, NDArray]:
    """Standard deviations of the cameras' centres (C,) [m] and focal lengths (C,) [px]."""
    variance = np.diag(system.covariances()[0]).reshape(cameras, -1)
    focal = variance[:, _POSE] if variance.shape[1] > _POSE else np.zeros(cameras)
    return np.sqrt(variance[:, :3].sum(axis=1)), np.sqrt(focal)
