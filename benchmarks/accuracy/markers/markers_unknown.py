"""Label sets that the catalogue does not know: `python -m benchmarks markers markers_unknown`.

Half of a take teaches, the other is named, a tenth lies between, its trajectories broken. The catalogue's set is kept
from it: segments come from motion alone, or from the first set that `kinefit markers set` writes from the half that
teaches, as it writes it (its words come from all sets of the catalogue, also from the take's own). Settings were chosen
on the takes with a star.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import tempfile
import time
from pathlib import Path

from benchmarks.figures import amount, figure
from benchmarks.scenes.marker_takes import HELD, broken, load, shares
from kinefit import load_body
from kinefit.errors import ObservationError
from kinefit.fitting.markers.first_set import first_set
from kinefit.markers.model.learn import learn_model
from kinefit.markers.take.takes import identify_take
from kinefit.observations import Markers

TAKES = {
    "61 markers": "nimblephysics/data__osim__WeirdFormatTests__markers.trc",
    "dance of 40": HELD[2].test[0],
    "golf swing": HELD[3].test[0],
    "dance *": "mocaprecovery/data__85_12.c3d",
    "hdm *": "mocaprecovery/data__HDM_mm_01-02_03_120.c3d",
    "jumps *": "c3d_to_xyz/01_01.c3d",
    "freeform *": "nimblephysics/data__c3d__nick_freeform_001.c3d",
    "squat *": "nimblephysics/data__c3d__squat.c3d",
    "sprint *": "nimblephysics/data__c3d__JA1Gait35.c3d",
}


def named(taught: Markers, asked: Markers, template: str) -> tuple[float, float, float, str]:
    """Right and wrong [%] of the labels seen, seconds; and why it was refused, if it was."""
    start = time.process_time()
    cut = broken(asked)
    try:
        model = learn_model(taught, template=template)
        start = time.process_time()
        found = identify_take(model, cut.markers)
    except ObservationError as error:
        return 0.0, 0.0, time.process_time() - start, error.problem
    spent = time.process_time() - start
    right, wrong = shares(found.column, cut, asked, model.labels)
    return 100 * right, 100 * wrong, spent, ""


def run() -> None:
    """The table and its figures."""
    body = load_body("humanoid")
    rows: list[tuple[str, str, float, float, float, str]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, file in amount(list(TAKES.items()), [("61 markers", TAKES["61 markers"])]):
            halves = load((file, 0.0, 0.45)), load((file, 0.55, 1.0))
            for taught, asked in (halves, halves[::-1])[: amount(2, 1)]:
                if taught is None or asked is None:
                    continue
                written = Path(folder) / "set.toml"
                written.write_text(first_set(taught, body=body).text, "utf-8")
                for how, template in (("motion alone", ""), ("first set", str(written))):
                    rows.append((name, how, *named(taught, asked, template)))
                    _, _, right, wrong, spent, why = rows[-1]
                    told = f"refused: {why}" if why else f"{right:6.2f} / {wrong:5.2f}"
                    print(f"{name:12s} {how:13s} {len(taught.names)} labels {spent:5.1f} s  {told}", flush=True)
    counted = [r for r in rows if not r[0].endswith("*")]
    reason = "" if counted else "no recordings"
    took = [r for r in counted if not r[5]]
    for tag, some in (("60_to_70", [r for r in took if r[0] == "61 markers"]), ("all", took)):
        figure(f"markers_unknown_{tag}_least", min((r[2] for r in some), default=None), "% right", ">= 95", reason)
    figure("markers_unknown_wrong", max((r[3] for r in took), default=None), "%", "<= 0.2", reason)
    refused = [r[4] for r in rows if r[5]]
    figure("markers_unknown_refused", max(refused, default=None), "s, slowest", "<= 10", reason or "none refused")
