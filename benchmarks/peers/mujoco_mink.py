"""MuJoCo: its kinematics and site Jacobians, damped Gauss-Newton in numpy; and mink with one stacked task.

mink's FrameTask has no point mode, and one task per marker is slower, so all markers make one task of ours.

Run as `python -m benchmarks.peers.mujoco_mink FOLDER mujoco|mink` with the peers' python.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.peers import Problem, marker_residuals, measure, read_problem
from benchmarks.peers._gauss_newton import THRESHOLDS, solve_sequence


def mjcf(problem: Problem) -> str:
    """MuJoCo's model as text: a free root, a hinge or slide per dof, a site per marker."""

    def numbers(values: list[float]) -> str:
        return " ".join(repr(float(value)) for value in values)

    def body(index: int) -> str:
        segment = problem.segments[index]
        kinds = {"revolute": "hinge", "prismatic": "slide"}
        joints = "".join(
            f'<joint name="{dof["name"]}" type="{kinds[dof["type"]]}" axis="{numbers(dof["axis"])}"/>'
            for dof in segment["dofs"]
        )
        sites = "".join(
            f'<site name="{marker["name"]}" pos="{numbers(marker["point"])}"/>'
            for marker in problem.markers
            if marker["segment"] == index
        )
        children = "".join(body(child) for child, other in enumerate(problem.segments) if other["parent"] == index)
        return (
            f'<body name="{segment["name"]}" pos="{numbers(segment["origin"])}">'
            f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            f"{'<freejoint/>' if segment['parent'] < 0 else joints}{sites}{children}</body>"
        )

    return f'<mujoco><compiler angle="radian"/><worldbody>{body(0)}</worldbody></mujoco>'


class Marked:
    """All markers of one MuJoCo model: positions and Jacobian."""

    def __init__(self, model: mujoco.MjModel, problem: Problem) -> None:
        self.model = model
        self.sites = np.array([model.site(marker["name"]).id for marker in problem.markers])
        self.jacobian = np.zeros((3 * len(self.sites), model.nv))
        blocks = self.jacobian.reshape(len(self.sites), 3, model.nv)
        self.rows = [(block, int(site)) for block, site in zip(blocks, self.sites, strict=True)]

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """Return the markers in the world, (3M,)."""
        return data.site_xpos[self.sites].ravel()

    def jacobians(self, data: mujoco.MjData) -> np.ndarray:
        """Return d points / d velocity, (3M, nv), overwritten by the next call."""
        for rows, site in self.rows:
            mujoco.mj_jacSite(self.model, data, rows, None, site)
        return self.jacobian


def configuration_order(problem: Problem, model: mujoco.MjModel) -> np.ndarray:
    """Place of every angle of the exchange format in qpos."""
    return np.array([model.joint(dof["name"]).qposadr[0] for segment in problem.segments for dof in segment["dofs"]])


def solve_with_mujoco(
    model: mujoco.MjModel, problem: Problem, start: np.ndarray, threshold: float
) -> tuple[list[np.ndarray], int]:
    """Damped Gauss-Newton on MuJoCo's site Jacobians."""
    data, marked = mujoco.MjData(model), Marked(model, problem)

    def linearise(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return marked.points(data), marked.jacobians(data)

    def integrate(q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        after = q.copy()
        mujoco.mj_integratePos(model, after, velocity, 1.0)
        return after

    targets = problem.positions.reshape(len(problem.positions), -1)
    return solve_sequence(linearise, integrate, start, targets, threshold)


def solve_with_mink(
    model: mujoco.MjModel, problem: Problem, start: np.ndarray, threshold: float
) -> tuple[list[np.ndarray], int]:
    """mink.solve_ik with its daqp solver, no limits, until the predicted decrease is below the threshold."""
    import mink

    marked = Marked(model, problem)

    class Markers(mink.Task):
        target: np.ndarray
        error: np.ndarray

        def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
            self.error = marked.points(configuration.data) - self.target
            return self.error

        def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
            return marked.jacobians(configuration.data)

    task, configuration = Markers(np.ones(3 * len(marked.sites))), mink.Configuration(model, start)
    tasks, solutions, iterations = [task], [], 0
    for target in problem.positions.reshape(len(problem.positions), -1):
        task.target = target
        for _ in range(50):
            iterations += 1
            step = mink.solve_ik(configuration, tasks, 1.0, "daqp", damping=1e-9, limits=[])
            decrease = -(task.error @ marked.jacobian) @ step
            configuration.integrate_inplace(step, 1.0)
            if decrease < threshold * (task.error @ task.error):
                break
        solutions.append(configuration.q.copy())
    return solutions, iterations


def main(folder: Path, peer: str) -> None:
    """Solve the problem in `folder` with `peer` ("mujoco" or "mink") and print the result."""
    problem = read_problem(folder)
    model = mujoco.MjModel.from_xml_string(mjcf(problem))
    order = configuration_order(problem, model)
    start = np.zeros(model.nq)
    start[:3] = problem.initial_root[:3, 3]
    mujoco.mju_mat2Quat(start[3:7], problem.initial_root[:3, :3].ravel())
    start[order] = problem.initial_angles

    def residuals(solution: list[np.ndarray]) -> np.ndarray:
        states, root = np.array(solution), np.tile(np.eye(4), (len(solution), 1, 1))
        flat = np.empty(9)
        for pose, q in zip(root, states, strict=True):
            mujoco.mju_quat2Mat(flat, q[3:7])
            pose[:3, :3], pose[:3, 3] = flat.reshape(3, 3), q[:3]
        return marker_residuals(problem, root, states[:, order])

    solve, name, notes = {
        "mujoco": (solve_with_mujoco, "MuJoCo", "mj_jacSite stacked in numpy, double precision"),
        "mink": (solve_with_mink, "mink", "solve_ik with one stacked task, daqp, no limits, double precision"),
    }[peer]
    truth = marker_residuals(problem, problem.truth_root, problem.truth_angles)
    run = partial(solve, model, problem, start)
    measure(name, version(peer), run, residuals, THRESHOLDS, truth, notes)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
