"""pyvale: digital image correlation of a pair of images, affine, with B-splines and its Gaussian prefilter.

Run by `benchmarks.peers.environments` as `python -m benchmarks.peers.pyvale_dic FOLDER` with a Python that has pyvale.
FOLDER holds ``pair.json``: the two images, the windows, the step, the seed and how often each is timed. For each window
``pyvale_WINDOW.npz`` gets ``points``, ``shift`` (N, 2) [px]; time is the processor's, of the whole call, least of
several.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import pyvale
from pyvale import dic


def main(folder: Path) -> None:
    """Print a line of JSON."""
    wanted = json.loads((folder / "pair.json").read_text())
    roi = np.zeros(wanted["shape"], bool)
    edge = wanted["edge"]
    roi[edge:-edge, edge:-edge] = True
    told: dict = {"peer": "pyvale", "version": pyvale.__version__}
    for window in wanted["windows"]:
        spent = []
        for _ in range(wanted["repeats"]):
            for old in folder.glob("dic_results_*"):
                old.unlink()
            began = time.process_time()
            dic.calculate_2d(
                reference=wanted["first"], deformed=wanted["second"], roi_mask=roi, seed=wanted["seed"],
                subset_size=window, subset_step=wanted["step"], num_threads=1, max_displacement=8,
                output_basepath=folder, print_level=0,
            )  # fmt: skip
            spent.append(time.process_time() - began)
        table = np.genfromtxt(next(folder.glob("dic_results_*.csv")), delimiter=",", skip_header=1)
        np.savez(folder / f"pyvale_{window}.npz", points=table[:, :2], shift=table[:, 2:4])
        told[str(window)] = {"points": len(table), "seconds": min(spent)}
    print(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
