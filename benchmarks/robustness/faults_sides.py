"""Left and right of real marker takes, mirrored and exchanged: `python -m benchmarks faults faults_sides`.

Every labelled take of a person is checked by `label_findings`, the function behind `kinefit markers fit`, `track`,
`check` and `markers audit`: as it is, mirrored, with left and right labels exchanged, with both, and with one
pair exchanged in all its frames. Thresholds were chosen on the takes of `SETTINGS`. The others are held out,
and their figures are printed apart. All frames are given; the check looks at 24 of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.figures import amount, data, figure
from kinefit.bodies import Body, load_body
from kinefit.bodies.marker_sets import find_placement, matched, side_pairs
from kinefit.errors import KinefitError
from kinefit.findings import Finding
from kinefit.fitting.markers.sides import label_findings
from kinefit.fitting.markers.subject import split_people
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers

SETTINGS = ("markers",)
HELD = ("markers_bmc_run", "markers_pycgm", "gait_biomechzoo", "gait_omcs", "forces_nimblephysics")
MIRRORED = "walk1.trc"
"""A take of markers_bmc_run that is itself in a mirrored world (`marker_takes.HELD`): no false alarm."""

NEIGHBOURS = (  # of one side: knee and ankle, heel and toe, by the labels of several sets
    ("RKNE", "RANK"), ("LHEE", "LTOE"), ("r_knee", "r_ankle"), ("L_calc", "L_toe"), ("R.Knee", "R.Ankle"),
    ("R.Heel", "R.Toe"), ("RLEPI", "RLMAL"), ("RHEEL", "RTOE"),
)  # fmt: skip
LEGS = ("thigh", "shank", "foot")  # segments of knees and feet: where all are marked, the sides have to be decided


def labelled(folders: tuple[str, ...], body: Body) -> Iterator[tuple[str, Markers]]:
    """Labelled takes of people below some folders of recordings, by file and person, where a set has their labels."""
    for folder in folders:
        root = data(folder)
        for path in sorted(p for p in (root.rglob("*") if root else ()) if p.suffix.lower() in (".c3d", ".trc")):
            try:
                people = split_people(read_markers(path))
            except KinefitError:  # files that are damaged on purpose
                continue
            for person, markers in people.items():
                try:
                    find_placement(body, markers.names)
                except KinefitError:
                    continue
                yield f"{folder}/{path.name}" + (f" {person}" if person else ""), markers


def mirrored(markers: Markers, axis: int = 2) -> Markers:
    """The take in a world with one axis negated."""
    return replace(markers, positions=markers.positions * np.where(np.arange(3) == axis, -1.0, 1.0))


def exchanged(markers: Markers, *pairs: tuple[str, str]) -> Markers:
    """The take with pairs of labels exchanged; with all left and right ones, if none is given."""
    image = dict(pairs or side_pairs(markers.names).items())
    image |= {b: a for a, b in image.items()}
    return replace(markers, names=tuple(image.get(n, n) for n in markers.names))


def verdict(found: tuple[Finding, ...]) -> str:
    """What findings say of the sides: "wrong", "undecided", or "" for nothing."""
    sides = [f.severity for f in found if f.kind == "sides"]
    return "wrong" if "fault" in sides else "undecided" if sides else ""


def run() -> None:
    """Print how many faults are named, of the takes on which thresholds were chosen and of the others."""
    body = load_body("humanoid")
    pairs_each = amount(4, 1)
    totals: dict[str, list[bool]] = {key: [] for key in ("mirrored", "exchanged", "clear", "false", "both", "pair")}
    for what, folders in (("chosen", SETTINGS), ("held out", HELD)):
        counts = {key: list[bool]() for key in totals}
        for k, (name, take) in enumerate(labelled(folders, body)):
            points = find_placement(body, take.names).points
            marked = {body.tree.segments[s] for s in points.segments}
            clear = all(any(s.startswith(part) for s in marked) for part in LEGS)
            if name.endswith(MIRRORED):
                take = mirrored(take)
            before = label_findings(body, take)
            counts["false"].append(any(f.severity == "fault" for f in before))
            for key, wrong in (("mirrored", mirrored(take, k % 3)), ("exchanged", exchanged(take))):
                said = verdict(label_findings(body, wrong))
                counts[key].append(bool(said))
                if clear:
                    counts["clear"].append(said == "wrong")
                if not said:
                    print(f"{name}: {key} passes")
            counts["both"].append(verdict(label_findings(body, exchanged(mirrored(take)))) == verdict(before))
            if not verdict(before):
                share = np.isfinite(take.positions[..., 0]).mean(axis=0)  # some labels are of a static trial alone
                known = zip(matched(take.names, points.names), take.names, share, strict=True)
                own = {label: name for label, name, part in known if label and part > 0.5}
                pairs = [p for p in side_pairs(points.names).items() if {*p} <= {*own}]
                few = {pairs[i] for i in np.linspace(0, len(pairs) - 1, min(pairs_each, len(pairs))).astype(int)}
                for a, b in sorted(few | {p for p in NEIGHBOURS if {*p} <= {*own}}):
                    found = label_findings(body, exchanged(take, (own[a], own[b])))
                    faults = [f.text.split() for f in found if (f.kind, f.severity) == ("labels", "fault")]
                    hit = any({a, b} <= {*words} for words in faults)
                    counts["pair"].append(hit)
                    if not hit:
                        print(f"{name}: {a} and {b} exchanged pass")
        each = [f"{key} {100 * np.mean(v):.1f} % of {len(v)}" for key, v in counts.items() if v]
        print(f"{what}, {len(counts['false'])} takes: {', '.join(each)}", flush=True)
        for key, values in counts.items():
            totals[key] += values
    shares = {key: 100.0 * float(np.mean(v)) if v else None for key, v in totals.items()}
    figure("faults_sides_mirrored", shares["mirrored"], "%", "== 100")
    figure("faults_sides_exchanged", shares["exchanged"], "%", "== 100")
    figure("faults_sides_named", shares["clear"], "%", "== 100")
    figure("faults_sides_false", float(sum(totals["false"])) if totals["false"] else None, "takes", "== 0")
    figure("faults_sides_both_silent", shares["both"], "%", "== 100")
    figure("faults_sides_pair", shares["pair"], "%", "== 100")
