"""Learn a marker model from labelled takes: distances, segments, joints (P5 2).

Check a training take: report joints that it did not exercise and markers that it hardly shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import RANGE, MarkerSet, find_marker_set, load_marker_set
from kinefit.errors import ObservationError
from kinefit.markers.model import from_frame
from kinefit.markers.model.clusters import learn_segments
from kinefit.markers.model.model import MarkerJoint, MarkerModel
from kinefit.markers.model.rigid import exercised_share, fit_joint, joint_ranges, reference_turn
from kinefit.observations import Markers
from kinefit.solving.functional_joints import nan_median, rigid_frames

MAX_FRAMES = 1000
"""Frames used, spread over the take: consecutive frames are alike."""

MIN_VISIBLE_SHARE = 0.01
"""Labels visible in a smaller share of the frames are excluded: mostly remains of editing ("RBAC-1")."""

MAX_EXTENT = 4.0
"""[m] largest extent of one subject's markers."""


@checked
def learn_model(markers: Markers, *, name: str = "subject", template: MarkerSet | str | None = None) -> MarkerModel:
    """Learn a subject's marker model from a labelled take.

    Parameters
    ----------
    markers : Markers, labelled; several takes of the subject put one after the other are one take
    template : MarkerSet, or the name or file of one
        Gives segments and joints, so that joints without motion do not merge segments. Default: the catalogue's set
        that knows the labels. "" learns the segments from motion alone.

    Raises
    ------
    ObservationError
        The template does not fit the labels, the labels spread over more than 4 m, or too few markers are visible.
    """
    marker_set = load_marker_set(template) if isinstance(template, str) and template else template
    if template is None:
        marker_set = find_marker_set(markers.names)
    positions, labels, gaps = usable_markers(markers, marker_set or None)
    with np.errstate(all="ignore"):
        extent = float(np.nanmedian(np.nanmax(positions, axis=1) - np.nanmin(positions, axis=1), axis=0).max())
    if not extent < MAX_EXTENT:
        raise ObservationError(
            f"the labels spread over {extent:.4g} m", file=markers.source or None,
            remedy="Learn one subject at a time, in the right unit (--unit mm ...).",
        )
    tables = distance_statistics(positions)
    if isinstance(marker_set, MarkerSet):
        skeleton = from_frame.assign_unknown(from_frame.skeleton_of(labels, marker_set), tables[1])
    else:
        skeleton = learn_segments(positions, labels, tables[0], tables[1])
    return fit_model(positions, labels, skeleton, tables, name, gaps)


def usable_markers(markers: Markers, marker_set: MarkerSet | None) -> tuple[NDArray, list[str], tuple[str, ...]]:
    """Select measured, labelled markers that are visible in enough frames.

    Returns
    -------
    positions (F, M, 3) [m] in at most MAX_FRAMES frames, M labels, labels that are rarely visible

    Raises
    ------
    ObservationError
        Fewer than three labelled markers are visible.
    """
    visible = np.isfinite(markers.positions[..., 0])
    keep = [
        i for i, label in enumerate(markers.names)
        if visible[:, i].sum() >= max(3, MIN_VISIBLE_SHARE * len(visible)) and not label.startswith("*")
        and not (marker_set and marker_set.is_computed(label))
    ]
    excluded = [n for i, n in enumerate(markers.names) if i not in keep and not n.startswith("*")]
    excluded = [n for n in excluded if not (marker_set and marker_set.is_computed(n))]
    if len(keep) < 3:
        problem, remedy = f"only {len(keep)} labelled markers are visible", "A model needs three or more."
        if all(label.startswith("*") for label in markers.names):
            problem = f"{len(markers.names)} trajectories without names"
            remedy = "Identify first: `kinefit markers identify TAKE SUBJECT.json`; learning needs labels."
        raise ObservationError(problem, file=markers.source or None, remedy=remedy)
    rows = np.flatnonzero(visible[:, keep].sum(1) >= 3)
    step = max(1, -(-len(rows) // MAX_FRAMES))
    gaps = excluded + [markers.names[i] for i in keep if visible[:, i].mean() < 0.1]
    return markers.positions[rows[::step]][:, keep], [markers.names[i] for i in keep], tuple(gaps)


def distance_statistics(positions: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """(M, M) [m] each: mean, standard deviation, least and largest distance; robust to a few wrong labels.

    Deviations from the median are clipped at five robust standard deviations. Least and largest: 0.5 % and 99.5 %
    quantiles. NaN for pairs that are never visible together.

    Parameters
    ----------
    positions : (F, M, 3) [m]; NaN where not visible
    """
    count = positions.shape[1]
    mean, deviation, low, high = (np.full((count, count), np.nan) for _ in range(4))
    for i in range(count):
        d = np.linalg.norm(positions[:, i:] - positions[:, i, None], axis=-1)
        visible = np.isfinite(d)
        for gaps in (False, True):  # numpy's NaN functions are many times slower
            pairs = np.flatnonzero(visible.any(0) & (visible.all(0) != gaps))
            if not pairs.size:
                continue
            x, median, quantile = d[:, pairs], *((np.nanmedian, np.nanquantile) if gaps else (np.median, np.quantile))
            medians = median(x, axis=0)
            limits = 5 * 1.4826 * median(np.abs(x - medians), axis=0) + 1e-4
            clipped = np.clip(x, medians - limits, medians + limits)
            found = np.nanmean(clipped, axis=0), np.nanstd(clipped, axis=0), *quantile(x, [0.005, 0.995], axis=0)
            for table, values in zip((mean, deviation, low, high), found):
                table[i, i + pairs] = table[i + pairs, i] = values
    return mean, deviation, low, high


def fit_model(
    positions: NDArray, labels: list[str], skeleton: from_frame.Skeleton,
    tables: tuple[NDArray, NDArray, NDArray, NDArray], name: str, gaps: tuple[str, ...],
) -> MarkerModel:
    """Fit reference shape, joints and distances of a model whose segments are known.

    Parameters
    ----------
    positions : (F, M, 3) [m] of the labels; NaN where not visible
    tables : (M, M) [m] mean, standard deviation, least and largest distances; see `distance_statistics`
    gaps : labels that are rarely visible

    Raises
    ------
    ObservationError
        No frame shows all segments.
    """
    mean, deviation, low, high = tables
    reference = mean_shape(positions, skeleton.members, mean)
    places = from_frame.place_joints(reference, skeleton)
    joints: list[MarkerJoint] = []
    Rs: list[NDArray] = []
    ts: list[NDArray] = []
    for s, members in enumerate(skeleton.members):
        p = skeleton.parents[s]
        x, y = reference[list(members)], positions[:, list(members)]
        if p < 0:
            R, t = rigid_frames(x, y, np.broadcast_to(np.eye(3), (len(y), 3, 3)))
        else:
            marker = from_frame.shared_marker(skeleton, s, places[s], reference)
            guess = places[s] if marker is None else reference[marker]
            a = b = guess
            if marker is None:
                R, t = rigid_frames(x, y, Rs[p])
                a, b = fit_joint(Rs[p], ts[p], R, t, x, y, guess)
            known = Rs[p] @ a + ts[p]
            R, t = rigid_frames(np.vstack([x, b]), np.concatenate([y, known[:, None]], 1), Rs[p])
            spread = np.linalg.norm(known - (R @ b + t), axis=-1)
            spread = spread[np.isfinite(spread)]
            typical = float(np.sqrt(np.median(spread**2))) if len(spread) else from_frame.JOINT_SPREAD
            is_observed = np.isfinite(y[..., 0]).sum(1) >= min(3, len(x))
            ranges = joint_ranges(Rs[p], R, is_observed)
            joint = MarkerJoint(p, s, a, b, typical, marker, ranges[0], ranges)
            share = exercised_share(joint, skeleton.ranges[s])
            turn, give = reference_turn(Rs[p], R, is_observed, skeleton.ranges[s])
            joint = replace(joint, turn=turn, give=give)
            prior_spread = max(typical, from_frame.MARKER_SPREAD if marker is not None else from_frame.JOINT_SPREAD)
            joints.append(replace(joint, spread=float(np.sqrt(share * typical**2 + (1 - share) * prior_spread**2))))
        Rs.append(R)
        ts.append(t)
    tree_low, tree_high = from_frame.reachable_distances(reference, skeleton.members, joints)
    reference_distances = np.linalg.norm(reference[:, None] - reference, axis=-1)
    mean = np.where(np.isfinite(mean), mean, reference_distances)
    guess = from_frame.prior_deviation(mean, skeleton, tree_low, tree_high)
    known = np.where(np.isfinite(deviation), exercised_shares(skeleton, joints, len(labels)), 0.0)
    deviation = np.nan_to_num(np.hypot(deviation, from_frame.DISTANCE_NOISE))
    deviation = np.sqrt(known * deviation**2 + (1 - known) * np.maximum(deviation, guess) ** 2)
    np.fill_diagonal(deviation, 0.0)
    low, high = np.fmin(low, mean), np.fmax(high, mean)
    low, high = low + (1 - known) * np.minimum(tree_low - low, 0), high + (1 - known) * np.maximum(tree_high - high, 0)
    segments = skeleton.members
    return MarkerModel(
        name, tuple(labels), reference, segments, skeleton.names, tuple(joints), mean, deviation, low, high, gaps
    )


def exercised_shares(skeleton: from_frame.Skeleton, joints: Sequence[MarkerJoint], count: int) -> NDArray:
    """(M, M) in 0..1: share of each distance's range that the training motion showed.

    Across joints: the least share of the joints between. Within a segment: the mean over its joints, as they move skin.
    """
    members = skeleton.members
    share = {j.child: exercised_share(j, skeleton.ranges[j.child]) for j in joints}
    parent = {j.child: j.parent for j in joints}
    known = np.ones((count, count))
    for a in range(len(members)):
        for b in range(a, len(members)):
            if a == b:
                adjacent_shares = [v for c, v in share.items() if a in (c, parent[c])]
                value = float(np.mean(adjacent_shares)) if adjacent_shares else 1.0
            else:
                value = min(share[s] for path in from_frame.joints_between(a, b, parent) for s in path)
            i, j = np.ix_(list(members[a]), list(members[b])), np.ix_(list(members[b]), list(members[a]))
            known[i] = np.minimum(known[i], value)
            known[j] = np.minimum(known[j], value)
    return known


def mean_shape(positions: NDArray, segments: tuple[tuple[int, ...], ...], mean: NDArray) -> NDArray:
    """(M, 3) [m] mean shape of each segment, fitted to the frame that shows most markers at nearly mean distances.

    Parameters
    ----------
    positions : (F, M, 3) [m]; NaN where not visible
    mean : (M, M) [m] distances

    Raises
    ------
    ObservationError
        No frame shows all segments.
    """
    visible = np.isfinite(positions[..., 0])
    candidates = np.flatnonzero(visible.sum(1) == visible.sum(1).max())
    candidates = candidates[:: max(1, len(candidates) // 200)]
    within = np.zeros(mean.shape, bool)
    for m in segments:
        within[np.ix_(m, m)] = True
    misfit = []
    for f in candidates:
        d = np.abs(np.linalg.norm(positions[f][:, None] - positions[f], axis=-1) - mean)[within]
        misfit.append(np.nanmean(d))
    frame = positions[candidates[int(np.argmin(misfit))]]
    sums, weights = np.zeros_like(frame), np.zeros(len(frame))
    prior = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    for m in segments:
        index = list(m)
        y = positions[:, index]
        shape = frame[index]
        if not np.isfinite(shape).all():
            counts = np.isfinite(y[..., 0]).sum(1)
            shape = y[int(np.argmax(counts))]
            shape = np.where(np.isfinite(shape), shape, np.nanmean(shape, axis=0))
        for _ in range(4):
            R, t = rigid_frames(shape, y, prior)
            local_points = np.einsum("fji,fkj->fki", R, y - t[:, None])
            finite = np.isfinite(local_points[..., 0])
            typical = nan_median(np.where(finite[..., None], local_points, np.nan), axis=0)
            shape = np.where(np.isfinite(typical), typical, shape)
        R, t = rigid_frames(shape, frame[None, index], prior[:1])
        if np.isfinite(t).all():
            sums[index] += shape @ R[0].T + t[0]
            weights[index] += 1
    placed = weights > 0
    if not placed.all():
        raise ObservationError("no frame shows all segments", remedy="Give a take in which every marker is visible.")
    return sums / weights[:, None]


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
