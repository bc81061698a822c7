"""OpenSim's inverse kinematics on a recorded take: time, marker errors, and the joint centres of its own results.

Run as `python -m benchmarks.peers.opensim_takes FOLDER` with the peer's python. The folder holds take.json:
model, setup, markers (TRC), reference (MOT of that model), joints {name: joint of the model}, and own: a folder with a
body.osim and markers.trc by kinefit. Joint centres and errors go to centres.npz there.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import opensim

from benchmarks.peers import read_mot

REPEATS = 2


def centres(model: opensim.Model, mot: Path, joints: dict[str, str]) -> np.ndarray:
    """(F, J, 3) [m] centres of joints over the frames of a motion of the model."""
    names, table = read_mot(mot)
    state = model.initSystem()
    coordinates = model.getCoordinateSet()
    turns = {n: coordinates.get(n).getMotionType() == 1 for n in names[1:]}
    out = np.empty((len(table), len(joints), 3))
    for f, row in enumerate(table):
        for name, value in zip(names[1:], row[1:], strict=True):
            coordinate = coordinates.get(name)
            coordinate.setLocked(state, False)
            coordinate.setValue(state, float(np.deg2rad(value) if turns[name] else value), False)
        model.realizePosition(state)
        for j, joint in enumerate(joints.values()):
            at = model.getJointSet().get(joint).getParentFrame().getPositionInGround(state)
            out[f, j] = [at.get(i) for i in range(3)]
    return out


def solve(tool: opensim.InverseKinematicsTool, trc: Path, folder: Path) -> tuple[float, int, np.ndarray]:
    """Seconds of the processor of the fastest run, frames, and (F,) [m] RMS error of the markers it follows."""
    tool.setMarkerDataFileName(str(trc))
    tool.setOutputMotionFileName(str(folder / "ik.mot"))
    tool.setResultsDir(str(folder))
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        tool.run()
        times.append(time.process_time() - start)
    (errors,) = folder.glob("*marker_errors.sto")
    names, table = read_mot(errors)
    out = table[:, names.index("marker_error_RMS")]
    errors.unlink()
    return min(times), len(table), out


def own_tool(folder: Path) -> tuple[opensim.InverseKinematicsTool, opensim.Model]:
    """Inverse kinematics of a body by kinefit, every marker of its file followed alike; and its model, to be kept."""
    model = opensim.Model(str(folder / "body.osim"))
    model.initSystem()
    tool = opensim.InverseKinematicsTool()
    tool.setModel(model)
    lines = (folder / "markers.trc").read_text(encoding="utf-8").splitlines()
    markers = model.getMarkerSet()
    known = {markers.get(i).getName() for i in range(markers.getSize())}
    for name in lines[3].split("\t")[2::3]:
        if name in known:
            task = opensim.IKMarkerTask()
            task.setName(name)
            task.setApply(True)
            task.setWeight(1.0)
            tool.upd_IKTaskSet().cloneAndAppend(task)
    rows = [line.split("\t") for line in lines[6:] if line.strip()]
    tool.setStartTime(float(rows[0][1]))
    tool.setEndTime(float(rows[-1][1]))
    return tool, model


def main(folder: Path) -> None:
    """Do what take.json says and print the result."""
    opensim.Logger.setLevelString("Error")
    given = json.loads((folder / "take.json").read_text(encoding="utf-8"))
    os.chdir(folder)
    model = opensim.Model(given["model"])
    points = centres(model, Path(given["reference"]), given["joints"])
    tool = opensim.InverseKinematicsTool(given["setup"])
    fresh = opensim.Model(given["model"])  # the tool keeps no hold of it
    tool.setModel(fresh)
    seconds, frames, errors = solve(tool, Path(given["markers"]), folder)
    own, _model = own_tool(Path(given["own"]))
    own_seconds, own_frames, own_errors = solve(own, Path(given["own"]) / "markers.trc", folder)
    np.savez(folder / "centres.npz", centres=points, errors=errors)
    result = {
        "peer": "OpenSim IK", "version": version("opensim"), "ms_per_frame": 1e3 * seconds / frames,
        "rms_mm": 1e3 * float(np.sqrt(np.mean(errors**2))), "own_ms_per_frame": 1e3 * own_seconds / own_frames,
        "own_rms_mm": 1e3 * float(np.sqrt(np.mean(own_errors**2))),
    }  # fmt: skip
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
