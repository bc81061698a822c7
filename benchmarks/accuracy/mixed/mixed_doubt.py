"""What is called doubtful, and what is wrong: of segments in frames of all simulated takes (for `mixed`).

An error is a segment of which an end (its joint centre, a child's, or where its surface ends) is farther than 5 cm from
the truth. It is said where the segment is doubtful in that frame (`kinefit.exporters.report.moments`); "said" counts
what is lost, too. All takes count together: precision is the share of what is said that is an error, recall the share
of the errors that is said. The area under the receiver operating characteristic (AUC) and the calibration error are of
the probability that the motion states: the latter is the mean of |share of errors - probability| over ten classes of
probability, each counted by its size. The limits were chosen on draws 0 to 35, one take of each: figures are of draws
36 and on.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from benchmarks.accuracy.mixed.mixed_runs import Outcome, Told
from benchmarks.figures import figure
from kinefit.exporters.report.moments import doubtful


def doubt(told: Told) -> None:
    """Print precision and recall of every run, and those of all."""
    failed = [one for draws in told.values() for one in draws if isinstance(one, str)]
    counts, all_of = np.zeros((2, 3), int), []
    for run, draws in told.items():
        kept = [o for o in draws if isinstance(o, Outcome)]
        if not kept:
            continue
        own = sum(_counts(o) for o in kept)
        counts += own
        all_of += [o.doubt[:2].reshape(2, -1) for o in kept]
        print(f"# {' '.join(run)}: {_text(own[0])}; with what is lost {_text(own[1])}", flush=True)
    reason = f"{len(failed)} runs failed, first {failed[0]}" if failed else ""
    for name, (hits, said, errors) in zip(("doubt", "said"), counts):
        some = bool(errors) and bool(said) and not failed
        figure(f"mixed_{name}_precision", hits / said if some else None, "of what is said", ">= 0.7", reason)
        figure(f"mixed_{name}_recall", hits / errors if some else None, "of errors above 5 cm", ">= 0.8", reason)
    auc = calibration = None
    if all_of and not failed:
        far, likely = np.concatenate(all_of, axis=1)
        far = far > 0
        ranks, errors, others = rankdata(likely), far.sum(), (~far).sum()
        auc = (ranks[far].sum() - errors * (errors + 1) / 2) / (errors * others) if errors and others else None
        classes = np.minimum((10 * likely).astype(int), 9)
        off = [abs(far[classes == c].mean() - likely[classes == c].mean()) for c in np.unique(classes)]
        calibration = float(np.average(off, weights=np.unique(classes, return_counts=True)[1]))
    figure("mixed_doubt_auc", auc, "AUC of errors above 5 cm", ">= 0.92", reason)
    figure("mixed_doubt_calibration", calibration, "expected calibration error of the probability", "<= 0.05", reason)


def _counts(o: Outcome) -> np.ndarray:
    """(2, 3) errors that are said, all that is said, all errors; by doubt alone, and by doubt or loss."""
    far, likely, against, lost = o.doubt
    far, lost, said = far > 0, lost > 0, doubtful(likely, against > 0)
    return np.array([[(far & told).sum(), told.sum(), far.sum()] for told in (said, said | lost)])


def _text(counts: np.ndarray) -> str:
    hits, said, errors = counts
    return f"precision {hits / max(said, 1):.2f}, recall {hits / max(errors, 1):.2f} of {errors} errors"
