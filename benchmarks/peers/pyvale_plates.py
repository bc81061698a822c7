"""pyvale on its own example pictures, drawn here by its renderer, with the truth: a rigid plate, a plate with a hole.

Run by `benchmarks.peers.environments` as `python -m benchmarks.peers.pyvale_plates FOLDER` with a Python that has
pyvale. FOLDER holds ``plates.json``: windows, step, margin, repeats, and of each case its frame. Each case gets a
folder with its pictures, ``truth.npz`` (nodes (N, 2) [px] of the first camera, how they move (N, 3) [mm] along its
axes) and for each window ``mono_WINDOW.npz`` and ``stereo_WINDOW.npz``: points (N, 2) [px] and shift (N, 2) [px] or
(N, 3) [mm]. Time is the processor's, of the whole call, least of several.

The lengths of the calibration that comes with the pictures are a tenth of those by which they are drawn, and motion is
counted from the deformed state back: both are put right here.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import pyvale
from pyvale import calib, data, dic
from pyvale.render import dicexamples

PIXEL = 0.1  # [mm] of the plate
CONVERGED, STEREO_CONVERGED = 5, 19  # columns


def main(folder: Path) -> None:
    """Print a line of JSON."""
    wanted = json.loads((folder / "plates.json").read_text())
    printed = os.dup(1)
    os.dup2(2, 1)  # the renderer prints
    told: dict = {"peer": "pyvale", "version": pyvale.__version__}
    stereo = calib.loadtxt(data.dic_ex08_stereo_calibration())
    for case, frame in wanted["cases"].items():
        mesh, _ = dicexamples._load_mesh(dicexamples._simulation_path(case))
        place = folder / case
        dicexamples._render_case(case, place, frame_labels=(0, 1), frame_indices=(0, frame))
        middle = 0.5 * (mesh.coords.min(0) + mesh.coords.max(0))
        nodes = 1e3 * (mesh.coords - middle)[:, :2] * (1, -1) / PIXEL + (520.0, 770.0)
        np.savez(place / "truth.npz", nodes=nodes, moved=1e3 * mesh.displacements[frame] * (1, -1, -1))
        first, second = ([next(place.glob(f"*_cam{c}_frame0{k}.tiff")) for c in (0, 1)] for k in (0, 1))
        roi = np.zeros((1540, 1040), bool)
        roi[wanted["margin"] : -wanted["margin"], wanted["margin"] : -wanted["margin"]] = True
        for window in wanted["windows"]:
            given = {
                "roi_mask": roi, "seed": wanted["seed"], "subset_size": window, "subset_step": wanted["step"],
                "num_threads": 1, "max_displacement": 100, "output_basepath": place, "print_level": 0,
            }  # fmt: skip
            for kind in ("mono", "stereo"):
                spent = []
                for _ in range(wanted["repeats"]):
                    for old in place.glob("dic_results_*"):
                        old.unlink()
                    began = time.process_time()
                    if kind == "mono":
                        dic.calculate_2d(reference=first[0], deformed=second[0], **given)
                    else:
                        deformed = [[second[0]], [second[1]]]
                        dic.calculate_3d(reference=first, deformed=deformed, calibration=stereo, **given)
                    spent.append(time.process_time() - began)
                file = sorted(place.glob("dic_results_*.csv"))[-1]
                table = np.genfromtxt(file, delimiter=",", skip_header=1)
                table = table[(table[:, CONVERGED] > 0) & (kind == "mono" or table[:, STEREO_CONVERGED] > 0)]
                shift = table[:, 2:4] if kind == "mono" else -10.0 * table[:, 13:16]
                np.savez(place / f"{kind}_{window}.npz", points=table[:, :2], shift=shift)
                told[f"{case} {kind} {window}"] = {"points": len(table), "seconds": min(spent)}
    os.dup2(printed, 1)
    print(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
