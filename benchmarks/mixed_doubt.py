"""What is called doubtful, and what is wrong: of segments in frames of all simulated takes (for `benchmarks.mixed`).

An error is a segment of which an end (its joint centre, a child's, or where its surface ends) is farther than 8 cm from
the truth. It is said where the segment is doubtful in that frame (`kinefit.exporters.report.moments`); "said" counts
what is lost, too. All takes count together: precision is the share of what is said that is an error, recall the share
of the errors that is said. The limit was chosen on draws 0 to 35, one take of each: figures are of draws 36 and on.
"""

from __future__ import annotations

import numpy as np

from benchmarks.figures import figure
from benchmarks.mixed_runs import Outcome, Told


def doubt(told: Told) -> None:
    """Print precision and recall of every run, and those of all."""
    failed = [one for draws in told.values() for one in draws if isinstance(one, str)]
    counts, frames = np.zeros((2, 3), int), []
    for run, draws in told.items():
        kept = [o for o in draws if isinstance(o, Outcome)]
        if not kept:
            continue
        own = sum(_counts(o) for o in kept)
        counts += own
        frames += [o.doubt[1].any(axis=1) for o in kept]
        share = 100 * np.concatenate([o.doubt[1].any(axis=1) for o in kept]).mean()
        print(f"# {' '.join(run)}: {_text(own[0])}; with what is lost {_text(own[1])}; {share:.0f} % of the frames")
    share = 100 * float(np.concatenate(frames).mean()) if frames else 0.0
    print(f"# all: {_text(counts[0])}; with what is lost {_text(counts[1])}; {share:.0f} % of the frames")
    reason = f"{len(failed)} runs failed, first {failed[0]}" if failed else ""
    for name, (hits, said, errors) in zip(("doubt", "said"), counts):
        some = bool(errors) and bool(said) and not failed
        figure(f"mixed_{name}_precision", hits / said if some else None, "of what is said", ">= 0.6", reason)
        figure(f"mixed_{name}_recall", hits / errors if some else None, "of errors above 8 cm", ">= 0.9", reason)


def _counts(o: Outcome) -> np.ndarray:
    """(2, 3) errors that are said, all that is said, all errors; by doubt alone, and by doubt or loss."""
    far, doubtful, lost = o.doubt
    return np.array([[(far & said).sum(), said.sum(), far.sum()] for said in (doubtful, doubtful | lost)])


def _text(counts: np.ndarray) -> str:
    hits, said, errors = counts
    return f"precision {hits / max(said, 1):.2f}, recall {hits / max(errors, 1):.2f} of {errors} errors"
