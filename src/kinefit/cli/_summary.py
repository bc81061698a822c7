"""The summary of a motion: how well cameras agree with it and each other, what was lost, how long the bones are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.limbs import finger_groups
from kinefit.bodies.motion import SHOWN_UNITS, Motion, Residuals, known_median
from kinefit.cli._screen import print_table, say
from kinefit.exporters.report.fit import point_medians, sensor_fits, value_text
from kinefit.exporters.report.methods import joint_distances
from kinefit.exporters.report.moments import doubt_sentence, doubtful_moments, throughout_sentence, unmarked, when
from kinefit.findings import FINDINGS, frame_ranges
from kinefit.takes.batch.results import description

MOMENTS = 5  # doubtful moments that are listed, the worst first


def print_summary(motion: Motion, *, points: bool = False) -> None:
    """Print it; with `points`, the residual of every point in every camera too."""
    seconds = len(motion) / motion.rate
    say(f"\n{motion.name}: {len(motion)} frames at {motion.rate:g} Hz ({seconds:.2f} s), body {motion.body.name}")
    if motion.residuals:
        rows = [
            (f.name, value_text(f.median, f.unit), f"{100 * f.left_out:.1f} %", f"{f.swapped} frames")
            for f in sensor_fits(motion)
        ]
        print_table(("sensor", "median residual", "rejected points", "left/right swaps"), rows)
    worst = int(np.argmin(motion.quality))
    say(f"quality: {motion.quality.mean():.2f} of 1 on average, lowest {motion.quality[worst]:.2f} in frame {worst}")
    moments = doubtful_moments(motion)
    say(f"doubtful moments: {doubt_sentence(motion, moments)}")
    for moment in moments[:MOMENTS]:
        say(f"  {when(motion, moment)}: {' '.join(moment.what)}")
    if len(moments) > MOMENTS:
        say(f"  and {len(moments) - MOMENTS} more, less severe")
    if throughout := throughout_sentence(motion):
        say(f"uncertain in most frames, at the far end (2 σ): {throughout}")
    unobserved = np.flatnonzero(motion.quality <= 0)
    if len(unobserved):
        say(f"person not found: frames {frame_ranges(unobserved)}")
    bare = without_markers(motion)
    for label, gone in (("no markers", bare), ("lost", lost_segments(motion))):
        never = [name for name, frames in gone.items() if len(frames) == len(motion) - len(unobserved)]
        if never:
            names = ", ".join(_hands_together(motion, {n: gone[n] for n in never}))
            say(f"{'lost in all frames' if label == 'lost' else 'not observed, as they have no markers'}: {names}")
        for name, frames in _hands_together(motion, {n: f for n, f in gone.items() if n not in never}).items():
            say(f"{label}: {name} in frames {frame_ranges(frames)}")
    lengths = [f"{name} {label}" for name, label in bone_lengths(motion).items()]
    if lengths:
        say("bone lengths [cm]: " + ", ".join(lengths))
    if points:
        _print_points(motion)


def as_record(motion: Motion, notes: Iterable[str], files: Mapping[str, Path]) -> dict[str, Any]:
    """The summary for programs: `kinefit track --json`."""
    return {
        "name": motion.name, "frames": len(motion), "rate_hz": motion.rate, "body": motion.body.name,
        "quality": round(float(motion.quality.mean()), 4),
        "residuals": {name: {"median": _median_of(r), "unit": r.unit} for name, r in motion.residuals.items()},
        "lost_frames": {name: frames.tolist() for name, frames in lost_segments(motion).items()},
        "findings": list(motion.provenance.get(FINDINGS, [])), "notes": list(notes),
        "files": {format: str(path) for format, path in files.items()},
    }  # fmt: skip


def print_files(files: Mapping[str, Path]) -> None:
    """Print what lies where."""
    say("\nWritten:")
    width = max((len(str(path)) for path in files.values()), default=0)
    for format, path in files.items():
        say(f"  {path!s:<{width}}  {description(format)}")


def lost_segments(motion: Motion) -> dict[str, NDArray]:
    """Segments that are lost, and in which frames somebody was tracked all the same; not those that bore no markers."""
    return _frames_of(motion, motion.lost & (motion.quality > 0)[:, None] & ~unmarked(motion))


def _frames_of(motion: Motion, gone: NDArray) -> dict[str, NDArray]:
    """Segments -> frames in which flags (F, S) are set; without those that have none."""
    frames = {name: np.flatnonzero(gone[:, s]) for s, name in enumerate(motion.body.tree.segments)}
    return {name: at for name, at in frames.items() if len(at)}


def _hands_together(motion: Motion, gone: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Segments -> frames; of each hand all its fingers as one, in frames in which any of them is gone."""
    out = dict(gone)
    for hand, segments in finger_groups(motion.body).items():
        if frames := [out.pop(s) for s in segments if s in out]:
            out[f"fingers of {hand}"] = np.unique(np.concatenate(frames))
    return out


def without_markers(motion: Motion) -> dict[str, NDArray]:
    """Segments without markers, in frames of which none is seen: they hang on their neighbours."""
    return _frames_of(motion, unmarked(motion))


def bone_lengths(motion: Motion) -> dict[str, str]:
    """Distances [cm] from joint to joint, one for left and right where they are alike."""
    found = joint_distances(motion.body)
    return {name: "/".join(dict.fromkeys(f"{cm:.1f}" for cm, _ in of.values())) for name, of in found.items()}


def _median_of(r: Residuals) -> float | None:
    """Median length of the residuals, in their unit; None where no point was seen."""
    median = known_median(r.norms)
    return median if np.isfinite(median) else None


def _print_points(motion: Motion) -> None:

    names = list(dict.fromkeys(name for r in motion.residuals.values() for name in r.names))
    medians = [(point_medians(r), SHOWN_UNITS[r.unit][1]) for r in motion.residuals.values()]
    rows = [
        (name, *(f"{of[name]:.1f} {unit}" if of.get(name, np.nan) >= 0 else "-" for of, unit in medians))
        for name in names
    ]
    say()
    print_table(("median residual of", *motion.residuals), rows)
