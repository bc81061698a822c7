"""Propose a marker set for labels unknown to the catalogue: left and right pairs, segments, places."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.body import Body
from kinefit.bodies.marker_sets.placement import placed
from kinefit.bodies.marker_sets.sets import LANDMARK_SPREAD, MarkerRecord, SetRecord, bare, catalogue, plain, side_pairs
from kinefit.errors import KinefitError
from kinefit.fitting.markers.subject import columns, fit_marker_subject, sequence_both_ways
from kinefit.markers.model.learn import learn_model, usable_markers
from kinefit.observations import Markers

MAX_SPREAD = 2 * LANDMARK_SPREAD
"""[m] largest spread of a marker whose word places a label: words of wands and clusters do not."""

BONES = {  # landmark of the right side by parts of a word, the more special ones first
    ("knee", "med"): "femoral_medial_epicondyle",
    ("ank", "med"): "medial_malleolus", ("malleol", "med"): "medial_malleolus",
    ("elb", "med"): "humeral_medial_epicondyle", ("wri", "uln"): "ulnar_styloid", ("wri", "med"): "ulnar_styloid",
    ("asis",): "asis", ("psis",): "psis", ("acrom",): "acromion", ("should",): "acromion", ("wri",): "radial_styloid",
    ("heel",): "calcaneus_posterior", ("calc",): "calcaneus_posterior", ("met", "1"): "metatarsal_phalanx_1",
    ("met", "5"): "metatarsal_phalanx_5", ("mt", "1"): "metatarsal_phalanx_1", ("mt", "5"): "metatarsal_phalanx_5",
    ("knee",): "femoral_lateral_epicondyle", ("ankle",): "lateral_malleolus", ("malleol",): "lateral_malleolus",
    ("elbow",): "humeral_lateral_epicondyle", ("troch",): "trochanterion", ("asi",): "asis", ("psi",): "psis",
}

MIN_KNOWN_LABELS = 8
MIN_SEGMENTS = 3
"""Labels with a known word, and their segments, that a body can be fitted to."""

BONE_DISTANCE_WEIGHT = 0.03
"""Weight of a marker's distance from the bone against its spread: without motion the nearest segment is chosen."""

MAX_SHARED_SIGMA = 0.010
MAX_JOINT_DISTANCE = 0.12
"""[m] a marker with less spread on a neighbouring segment, and nearer to their joint, belongs to both segments."""


@dataclass(frozen=True)
class FirstSet:
    """A proposed marker set.

    Parameters
    ----------
    text : TOML text of its file
    segments : labels by name of segment
    placed : labels whose place on the humanoid was fitted; none if too few labels have a known word
    paired : (right, left) labels
    """

    text: str
    segments: dict[str, tuple[str, ...]]
    placed: tuple[str, ...]
    paired: tuple[tuple[str, str], ...]


@checked
def first_set(markers: Markers, *, body: Body, name: str = "MY_SET") -> FirstSet:
    """Propose a marker set for a labelled take in which joints move, for the user to correct.

    Labels with words of the catalogue ("R.Knee", "knee_R") lie on its landmarks. The body is fitted to them, and every
    label is assigned to the segment that it moves with, symmetrically. If too few are known, segments and joints are
    learnt from motion alone, without places.

    Parameters
    ----------
    markers : labelled, of one subject
    body : generic humanoid

    Raises
    ------
    ObservationError
        Too few markers are visible.
    """
    _, labels, _ = usable_markers(markers, None)
    labels = [bare(label) for label in labels]
    pairs = side_pairs(labels)
    words = known_words(labels, pairs)
    found = _fit_segments(markers, labels, pairs, words, body)
    if found is None:
        model = learn_model(markers, template="")
        parents = {j.child: model.names[j.parent] for j in model.joints}
        segments = {n: tuple(bare(model.labels[m]) for m in s) for n, s in zip(model.names, model.segments)}
        links: dict[str, Link] = {n: (parents.get(i), None) for i, n in enumerate(model.names)}
        return FirstSet(_toml(name, segments, links, {}, {}), segments, (), tuple(pairs.items()))
    segments, links, places, at = found
    return FirstSet(_toml(name, segments, links, places, at), segments, tuple(places), tuple(pairs.items()))


def known_words(labels: Sequence[str], pairs: dict[str, str]) -> dict[str, tuple[MarkerRecord, bool]]:
    """Labels whose word a set of the catalogue places on a landmark: the set's row, and whether to mirror it."""
    middle, sided = dict[str, MarkerRecord](), dict[str, MarkerRecord]()
    for record in catalogue().values():
        for label, entry in record.markers.items():
            right = [r for r, _ in record.sides if record.mirror(label) and label.startswith(r)]
            word = label[len(right[0]) :] if right else None
            if entry.spread <= MAX_SPREAD:
                (middle if word is None else sided).setdefault(plain(label if word is None else word), entry)
    out = dict[str, tuple[MarkerRecord, bool]]()
    left = {v: k for k, v in pairs.items()}
    for label in labels:
        if label not in pairs and label not in left:
            if plain(label) in middle:
                out[label] = middle[plain(label)], False
            continue
        word = plain(_common_word(left.get(label, label), pairs))
        bone = next((bone for parts, bone in BONES.items() if all(part in word for part in parts)), None)
        if word in sided or bone:
            out[label] = sided.get(word) or MarkerRecord(landmark=f"r_{bone}", spread=MAX_SPREAD), label in left
    return out


def _common_word(label: str, pairs: dict[str, str]) -> str:
    """The common part of a right label and its left one."""
    left = pairs[label]
    common_tail = next((i for i in range(min(len(label), len(left))) if label[::-1][i] != left[::-1][i]), 0)
    start = next((i for i in range(min(len(label), len(left))) if label[i] != left[i]), 0)
    if start:
        return label[:start]
    tail = label[len(label) - common_tail :]
    return tail[1:] if plain(tail) in ("ight", "eft") else tail


Link = tuple[str | None, NDArray | None]
"""A segment's parent and their joint (3,) [m]; None for the root or if unknown."""

FittedSegments = tuple[dict[str, tuple[str, ...]], dict[str, Link], dict[str, NDArray], dict[str, tuple[str, NDArray]]]


def _fit_segments(
    markers: Markers, labels: list[str], pairs: dict[str, str], words: dict[str, tuple[MarkerRecord, bool]], body: Body
) -> FittedSegments | None:
    """Segments, links, places in the rest pose, places on segments [m]; None if no body can be fitted."""
    rows = {label: replace_side(entry, mirrored) for label, (entry, mirrored) in words.items()}
    points = placed(body, SetRecord(name="words", markers=rows)).points
    if len(points) < MIN_KNOWN_LABELS or len(set(points.segments.tolist())) < MIN_SEGMENTS:
        return None
    bare_markers = replace(markers, names=tuple(bare(n) for n in markers.names))
    try:
        subject = fit_marker_subject(replace(body, marker_sets={"words": points}), bare_markers, "words")
        x = columns(bare_markers, subject.points.names)
        poses = subject.body.tree.segment_poses(*sequence_both_ways(subject.body, subject.points, x, subject.sigma))
    except KinefitError:
        return None
    scale = subject.scales[body.segment_scale]
    tree = body.tree
    catalogue_names = {image for r in catalogue().values() for s in r.segment for image in (s.name, f"{s.name[:-2]}_l")}
    candidates = np.array([s for s, n in enumerate(tree.segments) if n in catalogue_names])
    ends = {s: [tree.rest[c] - tree.rest[s] for c in np.flatnonzero(tree.parents == s)] for s in candidates.tolist()}
    at, cost, sigma, poses = {}, {}, {}, poses[:, candidates]
    for label in labels:
        x = bare_markers.positions[:, bare_markers.names.index(label)]
        local = np.einsum("fsji,fsj->fsi", poses[..., :3, :3], x[:, None] - poses[..., :3, 3])
        middle = np.nanmedian(local, axis=0)
        sigma[label] = np.sqrt(np.nanmedian(((local - middle) ** 2).sum(-1), axis=0) / 3)
        at[label] = middle / scale[candidates, None]
        bone = [_bone_distance(at[label][i], ends[s]) for i, s in enumerate(candidates.tolist())]
        cost[label] = sigma[label] + BONE_DISTANCE_WEIGHT * np.array(bone)
    mirror = np.array([_mirror_index(tree.segments, candidates, s) for s in candidates.tolist()])
    home_of = {label: int(np.argmin(cost[label])) for label in labels}
    for right, left in pairs.items():
        if right in cost and left in cost:
            home_of[right] = int(np.argmin(cost[right] + cost[left][mirror]))
            home_of[left] = int(mirror[home_of[right]])
    members = {i: [label for label in labels if home_of[label] == i] for i in sorted(set(home_of.values()))}
    tied = _link_groups(members, candidates, tree.parents)
    joints = {c: tree.rest[candidates[max(c, p)]] for c, p in tied.items() if p is not None}
    for c, p in tied.items():
        for a, b in ((c, p), (p, c)) if p is not None else ():
            for label in [k for k in labels if home_of[k] == a]:
                near = np.linalg.norm(at[label][a] + tree.rest[candidates[a]] - joints[c]) < MAX_JOINT_DISTANCE
                if near and b is not None and sigma[label][b] < MAX_SHARED_SIGMA:
                    members[b].append(label)
    name = {i: tree.segments[candidates[i]] for i in members}
    segments = {name[i]: tuple(members[i]) for i in tied}
    linked: dict[str, Link] = {name[i]: (None if p is None else name[p], joints.get(i)) for i, p in tied.items()}
    places = {label: at[label][home_of[label]] + tree.rest[candidates[home_of[label]]] for label in labels}
    return segments, linked, places, {label: (name[home_of[label]], at[label][home_of[label]]) for label in labels}


def replace_side(entry: MarkerRecord, mirrored: bool) -> MarkerRecord:
    """A row of a marker set, mirrored to the other side if `mirrored`."""
    if not mirrored:
        return entry
    landmark, segment = entry.landmark, entry.segment
    if landmark is not None and landmark.startswith("r_"):
        landmark = f"l_{landmark[2:]}"
    if segment is not None and segment.endswith("_r"):
        segment = f"{segment[:-2]}_l"
    x, y, z = entry.offset
    at = None if entry.at is None else (entry.at[0], entry.at[1], -entry.at[2])
    return MarkerRecord(landmark=landmark, segment=segment, at=at, offset=(x, y, -z), spread=entry.spread)


def _bone_distance(at: NDArray, ends: list[NDArray]) -> float:
    """[m] distance of a point from a segment's bones, the lines from its origin to `ends`."""
    out = [float(np.linalg.norm(at))]
    for end in ends:
        along = float(np.clip(at @ end / max(end @ end, 1e-9), 0.0, 1.0))
        out.append(float(np.linalg.norm(at - along * end)))
    return min(out)


def _mirror_index(names: Sequence[str], candidates: NDArray, s: int) -> int:
    """Index among the candidates of the segment on the other side."""
    name = names[s]
    other = f"{name[:-2]}_l" if name.endswith("_r") else f"{name[:-2]}_r" if name.endswith("_l") else name
    return [names[c] for c in candidates].index(other)


def _link_groups(members: dict[int, list[str]], candidates: NDArray, parents: NDArray) -> dict[int, int | None]:
    """Each group's parent, parents first: its nearest ancestor with markers; the root has three markers."""
    place = {int(candidates[i]): i for i in members}
    links: dict[int, set[int]] = {i: set() for i in members}
    for i in members:
        s = int(parents[candidates[i]])
        while s >= 0 and s not in place:
            s = int(parents[s])
        ancestor = place[s] if s >= 0 else min(members)
        if ancestor != i:
            links[i].add(ancestor)
            links[ancestor].add(i)
    root = next((i for i in members if len(members[i]) >= 3), min(members))
    out: dict[int, int | None] = {root: None}
    queue = [root]
    while queue:
        i = queue.pop(0)
        for k in sorted(links[i] - set(out)):
            out[k] = i
            queue.append(k)
    return out


def _toml(
    name: str, segments: dict[str, tuple[str, ...]], links: dict[str, Link],
    places: dict[str, NDArray], at: dict[str, tuple[str, NDArray]],
) -> str:  # fmt: skip
    """The TOML text of the set."""
    def row(values: NDArray) -> str:
        return "[" + ", ".join(f"{v + 0.0:.3f}" for v in values) + "]"

    lines = [
        "# A first marker set, written by `kinefit markers set`. Check that every marker is on its segment.",
        "# [m] on a body of average size: x forward, y up, z to the right; positions, joints from the mid-hip.",
        f"name = {json.dumps(name)}", "",
    ]  # fmt: skip
    if places:
        lines += ["[places]", *(f"{json.dumps(k)} = {row(v)}" for k, v in places.items()), "", "[markers]"]
        for label, (segment, x) in at.items():
            lines.append(
                f"{json.dumps(label)} = {{ segment = {json.dumps(segment)}, at = {row(x)}, spread = {MAX_SPREAD:g} }}"
            )
        lines.append("")
    for segment, labels in segments.items():
        parent, joint = links[segment]
        lines += ["[[segment]]", f"name = {json.dumps(segment)}"]
        lines += [f"parent = {json.dumps(parent)}"] if parent else []
        lines += [f"joint = {row(joint)}"] if joint is not None else []
        lines += [f"markers = {json.dumps(list(labels))}", ""]
    return "\n".join(lines)
