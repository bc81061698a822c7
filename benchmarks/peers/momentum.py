"""Momentum (pymomentum-cpu): its own Gauss-Newton solver in C++, single precision, centimetres.

Run as `python -m benchmarks.peers.momentum FOLDER [planes]` with the peer's python.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pymomentum import geometry, solver2
from scipy.spatial.transform import Rotation

from benchmarks.peers import (
    Problem,
    axes_frame,
    marker_residuals,
    measure,
    plane_residuals,
    read_problem,
    root_frame,
)

CENTIMETRES = 100.0
THRESHOLDS = (1e7, 3e6, 1e6, 3e5, 1e5, 3e4, 1e4, 1e3, 1e2)  # in units of single precision's epsilon
REGULARIZATION = 0.05  # Momentum's default; less does not save an iteration and can diverge in single precision
TX, RX = 0, 3  # a Momentum joint: tx ty tz rx ry rz scale; parent * translation * pre-rotation * Rz * Ry * Rx


class Figure:
    """Momentum's character with one joint per segment where its axes are orthogonal, and the frames to get there."""

    def __init__(self, problem: Problem) -> None:
        self.joints: list[geometry.Joint] = []
        self.entries: list[tuple[int, int, float]] = []  # joint parameter, model parameter, factor
        self.frames: list[np.ndarray] = []  # of every joint, seen from the segment's frame in the rest pose
        self.segment_joints: list[int] = []
        column = 6
        for segment in problem.segments:
            if segment["parent"] < 0:
                joint = self.add_joint("root", -1, np.zeros(3), root_frame(problem.truth_root, 2, 0))
                self.entries += [(7 * joint + i, i, 1.0) for i in range(6)]
            else:
                joint, dofs = self.segment_joints[segment["parent"]], segment["dofs"]
                origin = np.array(segment["origin"], dtype=float)
                while dofs:
                    count = next(n for n in (3, 2, 1) if n <= len(dofs) and self.joinable(dofs[:n]))
                    joint = self.add_turning_joint(joint, origin, dofs[:count], column)
                    origin, dofs, column = np.zeros(3), dofs[count:], column + count
            self.segment_joints.append(joint)
        names = ["root_tx", "root_ty", "root_tz", "root_rx", "root_ry", "root_rz"]
        names += [dof["name"] for segment in problem.segments for dof in segment["dofs"]]
        transform = np.zeros((7 * len(self.joints), column), dtype=np.float32)
        for row, parameter, factor in self.entries:
            transform[row, parameter] = factor
        skeleton = geometry.Skeleton(self.joints)
        self.size = column
        self.character = geometry.Character("body", skeleton, geometry.ParameterTransform(names, skeleton, transform))

    @staticmethod
    def joinable(dofs: list[dict]) -> bool:
        """Whether the dofs fit into one joint of Momentum."""
        if any(dof["type"] == "prismatic" for dof in dofs):
            return len(dofs) == 1
        return axes_frame([dof["axis"] for dof in dofs]) is not None

    def add_joint(self, name: str, parent: int, origin: np.ndarray, frame: np.ndarray) -> int:
        """Append a joint at `origin` [m] in the parent segment's frame, with its axes along `frame`; its index."""
        before = self.frames[parent] if parent >= 0 else np.eye(3)
        turn = Rotation.from_matrix(before.T @ frame).as_quat()
        offset = CENTIMETRES * before.T @ origin
        self.joints.append(geometry.Joint(name, parent, turn.astype(np.float32), offset.astype(np.float32)))
        self.frames.append(frame)
        return len(self.joints) - 1

    def add_turning_joint(self, parent: int, origin: np.ndarray, dofs: list[dict], column: int) -> int:
        """Append the joint of up to three dofs with orthogonal axes, or of one prismatic dof; its index."""
        axes = [dof["axis"] for dof in dofs]
        frame, signs = axes_frame(axes)
        if dofs[0]["type"] == "prismatic":
            joint = self.add_joint(dofs[0]["name"], parent, origin, self.frames[parent])
            along = CENTIMETRES * self.frames[parent].T @ np.array(axes[0])
            self.entries += [(7 * joint + TX + i, column, along[i]) for i in range(3)]
            return joint
        frame = frame[:, ::-1] * [-1, 1, 1]  # columns x y z = -third, second, first axis: right-handed again
        joint = self.add_joint(dofs[0]["name"], parent, origin, frame)
        for i, sign in enumerate(signs):
            self.entries.append((7 * joint + RX + 2 - i, column + i, -sign if i == 2 else sign))
        return joint

    def offsets(self, segments: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (P, 3) [m] of segments (P,) as Momentum's joints (P,) and offsets (P, 3) [cm]."""
        joints = np.array(self.segment_joints)[segments]
        turned = np.einsum("pji,pj->pi", np.array(self.frames)[joints], points)
        return joints.astype(np.int32), (CENTIMETRES * turned).astype(np.float32)

    def parameters(self, root: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Model parameters of one pose: root (4, 4), angles (N,)."""
        frame = self.frames[0]
        z, y, x = Rotation.from_matrix(frame.T @ root[:3, :3] @ frame).as_euler("ZYX")
        return np.concatenate([CENTIMETRES * root[:3, 3], [x, y, z], angles]).astype(np.float32)

    def poses(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return roots (F, 4, 4) and angles (F, N) of model parameters (F, 6 + N)."""
        states, frame = parameters.astype(float), self.frames[0]
        root = np.tile(np.eye(4), (len(states), 1, 1))
        root[:, :3, :3] = frame @ Rotation.from_euler("ZYX", states[:, 5:2:-1]).as_matrix() @ frame.T
        root[:, :3, 3] = states[:, :3] / CENTIMETRES
        return root, states[:, 6:]


def solve_sequence(
    figure: Figure, error: solver2.SkeletonErrorFunction, renew: list, start: np.ndarray, threshold: float
) -> tuple[np.ndarray, int]:
    """Fit every frame from the one before; `renew` holds one call per frame that sets the targets of `error`."""
    options = solver2.GaussNewtonSolverOptions()
    options.max_iterations, options.threshold, options.regularization = 50, threshold, REGULARIZATION
    options.use_block_jtj = True
    solver = solver2.GaussNewtonSolver(solver2.SkeletonSolverFunction(figure.character, [error]), options)
    parameters, solutions, iterations = start, [], 0
    for set_targets in renew:
        set_targets()
        parameters = solver.solve(parameters)
        iterations += len(solver.per_iteration_errors)
        solutions.append(parameters)
    return np.array(solutions), iterations


def fit_markers(problem: Problem, figure: Figure) -> None:
    """Time the marker workload."""
    joints, offsets = figure.offsets(problem.marker_segments, problem.marker_points)
    error = solver2.PositionErrorFunction(figure.character)

    def setter(target: np.ndarray):
        def set_targets() -> None:
            error.clear_constraints()
            error.add_constraints(joints, target=target, offset=offsets)

        return set_targets

    renew = [setter(target) for target in (CENTIMETRES * problem.positions).astype(np.float32)]
    start = figure.parameters(problem.initial_root, problem.initial_angles)
    measure(
        "Momentum",
        version("pymomentum-cpu"),
        lambda threshold: solve_sequence(figure, error, renew, start, threshold),
        lambda solution: marker_residuals(problem, *figure.poses(solution)),
        THRESHOLDS,
        marker_residuals(problem, problem.truth_root, problem.truth_angles),
        f"GaussNewtonSolver in C++, regularization {REGULARIZATION:g}, single precision",
    )


def fit_planes(problem: Problem, figure: Figure) -> None:
    """Time the point-to-plane workload."""
    assert problem.planes is not None, "the folder has no point-to-plane rows"
    segment, point_local, normal_world, target_world = problem.planes
    joints, offsets = figure.offsets(segment, point_local)
    distances = CENTIMETRES * np.einsum("gpi,gpi->gp", normal_world, target_world)
    error = solver2.PlaneErrorFunction(figure.character)

    def setter(normal: np.ndarray, distance: np.ndarray):
        def set_targets() -> None:
            error.clear_constraints()
            error.add_constraints(normal, distance, joints, offset=offsets)

        return set_targets

    planes = zip(normal_world.astype(np.float32), distances.astype(np.float32), strict=True)
    renew = [setter(normal, distance) for normal, distance in planes]
    start = figure.parameters(problem.truth_root[0], problem.truth_angles[0])
    measure(
        "Momentum, points to planes",
        version("pymomentum-cpu"),
        lambda threshold: solve_sequence(figure, error, renew, start, threshold),
        lambda solution: plane_residuals(problem, *figure.poses(solution)),
        THRESHOLDS,
        plane_residuals(problem, problem.truth_root[: len(normal_world)], problem.truth_angles[: len(normal_world)]),
        f"GaussNewtonSolver in C++, regularization {REGULARIZATION:g}, {len(segment)} rows, single precision",
        repeats=3,
    )


def main(folder: Path, workload: str) -> None:
    """Solve the problem in `folder` and print the result."""
    problem = read_problem(folder)
    (fit_planes if workload == "planes" else fit_markers)(problem, Figure(problem))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "markers")
