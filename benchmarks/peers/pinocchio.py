"""Pinocchio: its kinematics and joint Jacobians, damped Gauss-Newton in numpy.

Run as `python -m benchmarks.peers.pinocchio FOLDER` with the peer's python.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pinocchio as pin

from benchmarks.peers import Problem, marker_residuals, measure, read_problem
from benchmarks.peers._gauss_newton import THRESHOLDS, solve_sequence


def build(problem: Problem) -> tuple[pin.Model, np.ndarray]:
    """Return the model, a free-flyer and one joint per dof, and the sign of every dof in it.

    Axes along a coordinate axis, either way, get the aligned joint types, which are faster.
    """
    model, carriers, signs = pin.Model(), [], []
    for segment in problem.segments:
        if segment["parent"] < 0:
            carriers.append(model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root"))
            continue
        joint, placement = carriers[segment["parent"]], pin.SE3(np.eye(3), np.array(segment["origin"], dtype=float))
        assert segment["dofs"], "a segment without dofs belongs to its parent"
        for dof in segment["dofs"]:
            axis = np.array(dof["axis"], dtype=float)
            along = [i for i in range(3) if abs(axis[i]) == 1]
            signs.append(axis[along[0]] if along else 1.0)
            if dof["type"] == "revolute":
                aligned = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
                kind = aligned[along[0]]() if along else pin.JointModelRevoluteUnaligned(axis)
            else:
                aligned = (pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ)
                kind = aligned[along[0]]() if along else pin.JointModelPrismaticUnaligned(axis)
            joint, placement = model.addJoint(joint, kind, placement, dof["name"]), pin.SE3.Identity()
        carriers.append(joint)
    for marker in problem.markers:
        at = pin.SE3(np.eye(3), np.array(marker["point"], dtype=float))
        model.addFrame(pin.Frame(marker["name"], carriers[marker["segment"]], 0, at, pin.FrameType.OP_FRAME))
    return model, np.array(signs)


def main(folder: Path) -> None:
    """Solve the problem in `folder` and print the result."""
    problem = read_problem(folder)
    model, signs = build(problem)
    data = model.createData()
    frames = [model.getFrameId(marker["name"]) for marker in problem.markers]
    supports = np.zeros((len(frames), 1, model.nv))
    for row, frame in enumerate(frames):
        for joint in model.supports[model.frames[frame].parentJoint]:
            if joint:
                supports[row, 0, model.idx_vs[joint] : model.idx_vs[joint] + model.nvs[joint]] = 1
    translations = [data.oMf[frame].translation for frame in frames]  # views of Pinocchio's memory
    columns, points = data.J, np.empty(3 * len(frames))
    stacked, lever = np.empty((len(frames), 3, model.nv)), np.zeros((len(frames), 3, 6))
    lever[:, :, :3] = np.eye(3)

    def linearise(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        np.concatenate(translations, out=points)
        x, y, z = points.reshape(-1, 3).T
        lever[:, 0, 4], lever[:, 0, 5] = z, -y
        lever[:, 1, 3], lever[:, 1, 5] = -z, x
        lever[:, 2, 3], lever[:, 2, 4] = y, -x
        np.dot(lever.reshape(-1, 6), columns, out=stacked.reshape(-1, model.nv))  # velocity at the marker
        np.multiply(stacked, supports, out=stacked)
        return points, stacked.reshape(-1, model.nv)

    start = np.concatenate([pin.SE3ToXYZQUAT(pin.SE3(problem.initial_root)), signs * problem.initial_angles])
    targets = problem.positions.reshape(len(problem.positions), -1)

    def residuals(solution: list[np.ndarray]) -> np.ndarray:
        root = np.array([pin.XYZQUATToSE3(q[:7]).homogeneous for q in solution])
        return marker_residuals(problem, root, signs * np.array(solution)[:, 7:])

    measure(
        "Pinocchio",
        pin.__version__,
        lambda threshold: solve_sequence(linearise, lambda q, v: pin.integrate(model, q, v), start, targets, threshold),
        residuals,
        THRESHOLDS,
        marker_residuals(problem, problem.truth_root, problem.truth_angles),
        "joint Jacobians stacked in numpy, double precision",
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
