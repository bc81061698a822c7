"""Check a training take: report joints that it did not exercise and markers that it hardly shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import RANGE, MarkerSet, find_marker_set
from kinefit.markers.model.model import MarkerJoint, MarkerModel
from kinefit.markers.model.rigid import exercised_share
from kinefit.observations import Markers

MIN_EXERCISED_SHARE = 0.35
"""Share of a joint's range below which it counts as still. In good training takes all joints but the wrists exceed it;
walking leaves shoulders, wrists, waist and neck below, standing all."""

MAX_SHAPE_DIFFERENCE = 0.01
"""[m] two segments whose distances agree this well are indistinguishable by shape: the skin motion of two markers."""

_MOTIONS = {
    "head": "nod, tilt and turn the head as far as it goes",
    "pelvis": "bend forward and to both sides, and twist the trunk",
    "upperarm": "swing the straight arm forward, out and overhead, and circle it",
    "forearm": "bend and stretch the elbow, and turn the palm up and down",
    "hand": "bend the wrist up, down and to both sides",
    "thigh": "lift the knee to the chest, and swing the leg out and back",
    "shank": "bend and stretch the knee all the way",
    "foot": "point the toes down and up, and circle the foot",
}


@dataclass(frozen=True)
class TrainingFinding:
    """One shortcoming of a training take.

    Parameters
    ----------
    kind : "unknown" (labels), "twice" (a label), "still" (a joint), "merged" (segments), "seldom" (a marker),
        "few" (markers on a segment), "alike" (segments)
    name : of the segment or label
    text : what was found
    remedy : what to record or to change
    """

    kind: str
    name: str
    text: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.name}: {self.text}. {self.remedy}."


@checked
def training_gate(
    markers: Markers, model: MarkerModel, *, marker_set: MarkerSet | None = None
) -> list[TrainingFinding]:
    """List the shortcomings of a training take, worst first; empty if there are none.

    Parameters
    ----------
    markers : the take from which `model` was learnt, or another take with its labels
    marker_set : for the full range of each joint; default: the catalogue's set that knows the labels
    """
    marker_set = marker_set or find_marker_set(model.labels)
    full = {s.name: s.range for s in marker_set.segments} if marker_set else {}
    still = []
    for joint in model.joints:
        name = model.names[joint.child]
        share = exercised_share(joint, full.get(name, RANGE))
        if share < MIN_EXERCISED_SHARE:
            still.append((share, _still_finding(model, joint, full.get(name, RANGE))))
    out = [f for _, f in sorted(still, key=lambda pair: pair[0])]
    unknown = _unknown(model) if marker_set is None else []
    return unknown + _duplicates(model) + out + _merged(model) + _rare(markers, model) + _few(model) + _alike(model)


def _unknown(model: MarkerModel) -> list[TrainingFinding]:
    """Labels that no set knows: their segments come from motion alone and need not be body parts."""
    sizes = sorted(zip((len(s) for s in model.segments), model.names), reverse=True)
    text = f"no set of the catalogue knows the labels; {len(sizes)} segments are from motion alone, the largest with "
    text += f"{sizes[0][0]} markers ({sizes[0][1]})"
    remedy = "Write a set: `kinefit markers set TAKE -o set.toml`, correct it, and learn with --set set.toml"
    return [TrainingFinding("unknown", model.name, text, remedy)]


def _duplicates(model: MarkerModel) -> list[TrainingFinding]:
    """Labels that appear twice in the file: the reader added a suffix to one of them."""
    parts = [(label, *label.rpartition("_")) for label in model.labels]
    duplicates = [(label, base) for label, base, _, n in parts if n.isdigit() and base in model.labels]
    text, remedy = "the file has the label {} twice", "Delete one of the two in the recording"
    return [TrainingFinding("twice", label, text.format(base), remedy) for label, base in duplicates]


def _still_finding(model: MarkerModel, joint: MarkerJoint, full: float) -> TrainingFinding:
    name, parent = model.names[joint.child], model.names[joint.parent]
    degrees = [f"{np.degrees(r):.0f}" for r in joint.ranges]
    motion = _MOTIONS.get(name.removesuffix("_r").removesuffix("_l").replace("_", ""), "turn it about all its axes")
    side = " (right)" if name.endswith("_r") else " (left)" if name.endswith("_l") else ""
    return TrainingFinding(
        "still", name, f"turned against {parent} by {degrees[0]}, {degrees[1]} and {degrees[2]} degrees about three "
        f"axes, of about {np.degrees(full):.0f} about the first", f"Record: {motion}{side}",
    )


def _merged(model: MarkerModel) -> list[TrainingFinding]:
    """Segments longer than any trunk or thigh: probably several that did not move against each other."""
    out = []
    for name, members in zip(model.names, model.segments):
        length = float(model.mean[np.ix_(members, members)].max())
        if length > 0.75:  # [m] trunk, shoulder to hip, of a very tall man (ANSUR II, 99th percentile and more)
            text = f"its {len(members)} markers lie up to {length:.2f} m apart: probably several segments in one"
            out.append(TrainingFinding("merged", name, text, "Correct the marker set, or record all joints moving"))
    return out


def _rare(markers: Markers, model: MarkerModel) -> list[TrainingFinding]:
    index = {name: i for i, name in enumerate(markers.names)}
    out = []
    for label in model.gaps:
        share = np.isfinite(markers.positions[:, index[label], 0]).mean() if label in index else 0.0
        text = f"visible in {100 * share:.0f} % of the frames" + ("" if label in model.labels else "; not in the model")
        out.append(TrainingFinding("seldom", label, text, "Record it, or remove the label"))
    return out


def _few(model: MarkerModel) -> list[TrainingFinding]:
    """Segments with too few markers for a pose: fewer than three with the joint, or on one line."""
    out = []
    joints = {j.child: j.in_child for j in model.joints}
    for s, (name, members) in enumerate(zip(model.names, model.segments)):
        points = model.reference[list(members)]
        points = np.vstack([points, joints[s]]) if s in joints else points
        flat = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if len(points) < 3 or flat[1] < 0.02:  # [m] off one line
            text = f"{len(members)} markers" + (", nearly on one line with its joint" if len(points) > 2 else "")
            out.append(TrainingFinding("few", name, text, "Add a marker off the line, or expect uncertain names there"))
    return out


def _alike(model: MarkerModel) -> list[TrainingFinding]:
    """Pairs of segments (left and right) with the same distances, which only their neighbours distinguish."""
    out = []
    for a in range(len(model.segments)):
        for b in range(a):
            first, second = model.segments[b], model.segments[a]
            if len(first) != len(second) or len(first) < 2 or set(first) & set(second):
                continue
            i, j = np.triu_indices(len(first), 1)
            d = model.mean[np.ix_(first, first)][i, j] - model.mean[np.ix_(second, second)][i, j]
            if np.abs(d).max() < MAX_SHAPE_DIFFERENCE:
                text = f"same shape as {model.names[b]} within {1e3 * np.abs(d).max():.0f} mm"
                remedy = "Move one marker by 3 cm, or add one on one side"
                out.append(TrainingFinding("alike", model.names[a], text, remedy))
    return out
