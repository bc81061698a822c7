"""OpenSim's inverse kinematics on folders of `kinefit markers fit`: RMS of the markers, by its angles and by kinefit's.

Run as `python -m benchmarks.peers.opensim_sets FOLDER` with the peer's python. Every folder in it with a body.osim also
holds markers.trc and motion.mot.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import opensim

from benchmarks.peers import read_mot
from benchmarks.peers.opensim_takes import own_tool


def own_angles(folder: Path) -> float:
    """[mm] RMS distance of the model's markers at kinefit's angles from the measured ones."""
    model = opensim.Model(str(folder / "body.osim"))
    state, (names, table) = model.initSystem(), read_mot(folder / "motion.mot")
    coordinates, markers = model.getCoordinateSet(), model.getMarkerSet()
    known = {markers.get(i).getName() for i in range(markers.getSize())}
    lines = (folder / "markers.trc").read_text(encoding="utf-8").splitlines()
    labels = lines[3].split("\t")[2::3]
    squares = []
    for row, line in zip(table, (line for line in lines[6:] if line.strip()), strict=True):
        for name, value in zip(names[1:], row[1:], strict=True):
            turns = coordinates.get(name).getMotionType() == 1
            coordinates.get(name).setValue(state, float(np.deg2rad(value) if turns else value), False)
        model.realizePosition(state)
        cells = line.split("\t")[2:]
        for k, label in enumerate(labels):
            if label in known and all(cells[3 * k : 3 * k + 3]):
                at = markers.get(label).getLocationInGround(state)
                squares.append(sum((at.get(i) - float(cells[3 * k + i])) ** 2 for i in range(3)))
    return 1e3 * float(np.sqrt(np.mean(squares)))


def main(folder: Path) -> None:
    """Solve every folder and print {folder: {"rms_mm", "own_angles_mm", "markers"}}."""
    opensim.Logger.setLevelString("Error")
    os.chdir(folder)
    out = {}
    for path in sorted(p.parent for p in folder.glob("*/body.osim")):
        tool, _model = own_tool(path)
        tool.setMarkerDataFileName(str(path / "markers.trc"))
        tool.setOutputMotionFileName(str(path / "ik.mot"))
        tool.setResultsDir(str(path))
        tool.run()
        (errors,) = path.glob("*marker_errors.sto")
        names, table = read_mot(errors)
        rms = 1e3 * float(np.sqrt(np.mean(table[:, names.index("marker_error_RMS")] ** 2)))
        out[path.name] = {"rms_mm": rms, "own_angles_mm": own_angles(path), "markers": tool.upd_IKTaskSet().getSize()}
    print(json.dumps(out), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
