"""Jumps against force plates, squats and rises from a seat counted, by `find_movements`.

    python -m benchmarks gait gait_movements

Two people, each file fitted by `kinefit markers fit`. A flight lasts while no plate bears 20 N, at 10 ms. What ends it
in a motion was chosen on the first file, which is not among the figures.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.accuracy.gait.gait_events import fitted
from benchmarks.figures import amount, data, figure
from kinefit.exporters.movements import find_movements

_JUMPS = ("subject4/DJ1", "subject4/DJ2", "opencap/DJ1")
_COUNTED = {"subject4/squats1": "squat", "subject4/STSweakLegs1": "sit to stand"}
_TIMES = 5  # of each, as one sees in the recording
_FORCE_N = 20.0


def run() -> None:
    """Print errors of flights, and how many movements were counted too many or too few."""
    folder = data("forces_nimblephysics")
    errors, wrong = list[float](), 0
    for number, name in enumerate(_JUMPS[: amount(None, 1)] if folder else ()):
        assert folder is not None
        found = [one for one in find_movements(fitted(folder / f"{name}.trc")) if one.kind == "jump"]
        truth = _flight(folder / f"{name}_grf.mot")
        flights = [one.values["flight time [s]"][0] for one in found]
        print(f"# {name}: {len(found)} jumps, {flights} s, {truth:.2f} s by the plates")
        errors += [1e3 * abs(flights[0] - truth)] if number and len(flights) == 1 else []
        wrong += abs(len(flights) - 1)
    for name, kind in list(_COUNTED.items())[: amount(None, 1)] if folder else ():
        assert folder is not None
        found = find_movements(fitted(folder / f"{name}.trc"))
        print(f"# {name}: {[one.kind for one in found]}")
        wrong += abs(sum(one.kind == kind for one in found) - _TIMES) + sum(one.kind != kind for one in found)
    reason = "" if errors else "no recording, or the first file alone"
    figure("gait_jump_flight_ms", max(errors) if errors else None, "ms at most", "<= 20", reason)
    figure("gait_movements_wrong", wrong if folder else None, "counted wrong", "== 0", "" if folder else "no recording")


def _flight(path: Path) -> float:
    """[s] of the last time without force between two with it."""
    lines = path.read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if line.strip() == "endheader")
    names, table = lines[head + 1].split(), np.array([line.split() for line in lines[head + 2 :]], float)
    force = table[:, [k for k, name in enumerate(names) if name.endswith("vy")]].sum(axis=1)
    ends = np.flatnonzero(np.diff((force > _FORCE_N).astype(int)))
    return float(table[ends[-1], 0] - table[ends[-2], 0])
