"""OpenSim: its InverseKinematicsSolver (Simbody's assembler), on a model with its native joints.

Run as `python -m benchmarks.peers.opensim_ik FOLDER` with the peer's python.
"""

from __future__ import annotations

import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
import opensim
from scipy.spatial.transform import Rotation

from benchmarks.peers import Problem, axes_frame, marker_residuals, measure, read_problem, root_frame

ACCURACIES = (1e-5, 1e-6, 5e-7, 3e-7, 1e-7, 1e-8)  # relative; the first is OpenSim's default
RATE = 100.0  # frames a second, only to tell them apart


def vec3(values: np.ndarray) -> opensim.Vec3:
    """Return OpenSim's vector of three numbers."""
    return opensim.Vec3(*(float(value) for value in values))


def new_body(name: str) -> opensim.Body:
    """Body with unit inertia, which kinematics does not feel."""
    return opensim.Body(name, 1.0, opensim.Vec3(0), opensim.Inertia(1, 1, 1))


def euler_xyz(frame: np.ndarray) -> opensim.Vec3:
    """Body-fixed x-y-z angles of a constant frame (3, 3); any solution of several will do."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return vec3(Rotation.from_matrix(frame).as_euler("XYZ"))


def split(dofs: list[dict]) -> list[list[dict]]:
    """Dofs in groups that OpenSim's slider, pin, universal or gimbal joint can take."""
    groups: list[list[dict]] = []
    while dofs:
        turning = [all(dof["type"] == "revolute" for dof in dofs[:n]) for n in range(4)]
        orthogonal = (n for n in (3, 2) if n <= len(dofs) and turning[n] and axes_frame([d["axis"] for d in dofs[:n]]))
        count = next(orthogonal, 1)
        groups.append(dofs[:count])
        dofs = dofs[count:]
    return groups


def join(
    dofs: list[dict], name: str, parent: opensim.Body, origin: np.ndarray, body: opensim.Body
) -> tuple[opensim.Joint, list[float]]:
    """Join by the one joint for this group of dofs; the signs of its coordinates."""
    frame, signs = axes_frame([dof["axis"] for dof in dofs])
    kind = (opensim.PinJoint, opensim.UniversalJoint, opensim.GimbalJoint)[len(dofs) - 1]
    if dofs[0]["type"] == "prismatic":
        kind = opensim.SliderJoint  # along x
    elif len(dofs) == 1:
        frame = frame[:, [1, 2, 0]]  # a pin turns about z
    turn = euler_xyz(frame)
    return kind(name, parent, vec3(origin), turn, body, opensim.Vec3(0), turn), signs


class Figure:
    """OpenSim's model, its state, and the places and signs of all angles in the state's Q."""

    def __init__(self, problem: Problem) -> None:
        self.model = opensim.Model()
        self.frame = root_frame(problem.truth_root, 0, 2)
        turn, zero = euler_xyz(self.frame), opensim.Vec3(0)
        bodies, coordinates, signs = [], [], []

        def add(joint: opensim.Joint, body: opensim.Body) -> opensim.Body:
            self.model.addBody(body)
            self.model.addJoint(joint)
            coordinates.extend(joint.get_coordinates(i) for i in range(joint.numCoordinates()))
            return body

        for segment in problem.segments:
            if segment["parent"] < 0:
                body = new_body(segment["name"])
                free = opensim.FreeJoint("root", self.model.getGround(), zero, turn, body, zero, turn)
                bodies.append(add(free, body))
                continue
            last, origin = bodies[segment["parent"]], np.array(segment["origin"], dtype=float)
            for dofs in split(segment["dofs"]):
                body = new_body(dofs[-1]["name"] + "_body")
                joint, turned = join(dofs, dofs[0]["name"] + "_joint", last, origin, body)
                last, origin = add(joint, body), np.zeros(3)
                signs += turned
            bodies.append(last)
        for marker in problem.markers:
            at = vec3(marker["point"])
            self.model.addMarker(opensim.Marker(marker["name"], bodies[marker["segment"]], at))
        self.coordinates, self.signs = coordinates, np.array(signs)
        for coordinate in coordinates:
            coordinate.set_clamped(False)
        self.state = self.model.initSystem()
        for i, coordinate in enumerate(coordinates):
            coordinate.setValue(self.state, 0.01 * (i + 1), False)
        marked = np.rint(100 * self.state.getQ().to_numpy()).astype(int) - 1  # one slot of the root's is not used
        self.order = np.array([int(np.flatnonzero(marked == i)[0]) for i in range(len(coordinates))])

    def set_pose(self, root: np.ndarray, angles: np.ndarray) -> None:
        """Put the state to root (4, 4), angles (N,)."""
        turned = Rotation.from_matrix(self.frame.T @ root[:3, :3] @ self.frame).as_euler("XYZ")
        values = np.concatenate([turned, self.frame.T @ root[:3, 3], angles * self.signs])
        for coordinate, value in zip(self.coordinates, values, strict=True):
            coordinate.setValue(self.state, float(value), False)

    def poses(self, solution: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return roots (F, 4, 4) and angles (F, N) of the Q of all frames."""
        values = np.array(solution)[:, self.order]
        root = np.tile(np.eye(4), (len(values), 1, 1))
        root[:, :3, :3] = self.frame @ Rotation.from_euler("XYZ", values[:, :3]).as_matrix() @ self.frame.T
        root[:, :3, 3] = values[:, 3:6] @ self.frame.T
        return root, values[:, 6:] * self.signs


def markers_reference(problem: Problem) -> opensim.MarkersReference:
    """All targets as OpenSim's reference, with weight 1 for every marker."""
    table = opensim.TimeSeriesTableVec3()
    table.setColumnLabels([marker["name"] for marker in problem.markers])
    for frame, targets in enumerate(problem.positions):
        table.appendRow(frame / RATE, opensim.RowVectorVec3([vec3(target) for target in targets]))
    table.addTableMetaDataString("DataRate", str(RATE))
    table.addTableMetaDataString("Units", "m")
    return opensim.MarkersReference(table, opensim.SetMarkerWeights())


def main(folder: Path) -> None:
    """Solve the problem in `folder` and print the result."""
    opensim.Logger.setLevelString("Error")
    problem = read_problem(folder)
    figure, reference = Figure(problem), markers_reference(problem)

    def solve(accuracy: float) -> tuple[list[np.ndarray], None]:
        solver = opensim.InverseKinematicsSolver(
            figure.model, reference, opensim.SimTKArrayCoordinateReference(), np.inf
        )
        solver.setAccuracy(accuracy)
        figure.set_pose(problem.initial_root, problem.initial_angles)
        figure.state.setTime(0.0)
        solver.assemble(figure.state)
        solutions = [figure.state.getQ().to_numpy().copy()]
        for frame in range(1, len(problem.positions)):
            figure.state.setTime(frame / RATE)
            solver.track(figure.state)
            solutions.append(figure.state.getQ().to_numpy().copy())
        return solutions, None

    measure(
        "OpenSim IK",
        version("opensim"),
        solve,
        lambda solution: marker_residuals(problem, *figure.poses(solution)),
        ACCURACIES,
        marker_residuals(problem, problem.truth_root, problem.truth_angles),
        "InverseKinematicsSolver; pin, universal and gimbal joints",
        repeats=2,
        default=ACCURACIES[0],
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
