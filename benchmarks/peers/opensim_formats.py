"""Bodies of an .osim model over a .mot, and the markers of a .trc, as OpenSim reads them.

Run as `python -m benchmarks.peers.opensim_formats FOLDER` with the peer's python. The folder holds body.osim,
motion.mot and motion.trc. Origins of all bodies in the ground go to opensim-mot.npz, markers to opensim-trc.npz there,
{name: (F, 3) [m]}.
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import opensim


def bodies(folder: Path) -> dict[str, np.ndarray]:
    """{body: (F, 3)} over the motion."""
    model = opensim.Model(str(folder / "body.osim"))
    state = model.initSystem()
    table = opensim.TimeSeriesTable(str(folder / "motion.mot"))
    coordinates = model.getCoordinateSet()
    degrees = table.getTableMetaDataString("inDegrees") == "yes"
    out = {model.getBodySet().get(i).getName(): [] for i in range(model.getBodySet().getSize())}
    columns = [(coordinates.get(n), table.getDependentColumn(n).to_numpy()) for n in table.getColumnLabels()]
    for f in range(table.getNumRows()):
        for coordinate, values in columns:
            turns = degrees and coordinate.getMotionType() == 1
            coordinate.setLocked(state, False)
            coordinate.setValue(state, float(np.deg2rad(values[f]) if turns else values[f]), False)
        model.realizePosition(state)
        for name, places in out.items():
            at = model.getBodySet().get(name).getPositionInGround(state)
            places.append([at.get(i) for i in range(3)])
    return {name: np.array(places) for name, places in out.items()}


def markers(path: Path) -> dict[str, np.ndarray]:
    """{marker: (F, 3)} [m] of a TRC file."""
    table = opensim.TimeSeriesTableVec3(str(path))
    factor = {"m": 1.0, "cm": 0.01, "mm": 0.001}[table.getTableMetaDataString("Units")]
    flat = table.flatten()  # columns NAME_1, NAME_2, NAME_3
    names = {label.rpartition("_")[0] for label in flat.getColumnLabels()}
    axes = {name: [flat.getDependentColumn(f"{name}_{k}").to_numpy() for k in (1, 2, 3)] for name in names}
    return {name: factor * np.stack(columns, axis=1) for name, columns in axes.items()}


def main(folder: Path) -> None:
    """Read all files and print where the results lie."""
    np.savez(folder / "opensim-mot.npz", **bodies(folder))
    np.savez(folder / "opensim-trc.npz", **markers(folder / "motion.trc"))
    print(json.dumps({"peer": "opensim", "version": version("opensim")}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
