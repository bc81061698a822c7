"""Track all people across cameras and time (multi-view association of detections).

Each person's points in space are predicted for the next frame. In every camera, people and detections are assigned at
the least total cost, and views that disagree with a person's other views are rejected. If two tracks have views of one
person, one of them gets none in that frame; neither does a track with a single view within a step of another person, or
with one off its prediction that may be of somebody within two steps without a view in that image.
Unassigned detections that agree in enough cameras start a new person or continue one that was just lost nearby. A
backward pass adds earlier detections of each person. Longer absences are bridged by re-identification, see `returns`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.fitting.multiview import association
from kinefit.fitting.multiview.association import Node
from kinefit.fitting.multiview.likeness import ImageSource
from kinefit.fitting.multiview.returns import MAX_SHORT_ABSENCE_S, Chain, PresenceSpan, Return, link_spans
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.observations import MEDIAPIPE_478, Keypoints
from kinefit.observations.recordings import mirror_name

_MAX_DETECTION_DISTANCE = 0.25  # relative to the detection's height, plus the motion of ...
_ASSUMED_STATURE = 1.7  # [m] ... a person of this stature between frames; at most half a height
_MAX_VIEW_ERROR = 0.08  # reprojection error of a person's views, relative to the height; of two see `association`
_MAX_LONE_VIEW_ERROR = 0.12  # of a single view from its prediction, where it may be of another person
_MAX_PAIR_STEP = 0.05  # [m] of points from two views only, from their prediction
_MIN_PERSON_DISTANCE = 0.2  # [m] nearer points are duplicate detections of one person
_MIN_PRESENCE_S = 1.0  # of a person; half of a take shorter than two seconds
SPEED_INTERVAL_S = 0.2  # for speeds: over less, noise is as large as the motion


@dataclass(frozen=True, eq=False)
class PersonTrack:
    """One of the people in view.

    Parameters
    ----------
    chosen : for each record (F,) int, index of the person's detection in each frame, -1 for none
    views : (F,) number of cameras that see the person
    confidence : sum of the confidences of all keypoints in all frames
    speed : [m/s] of the body's points, mean over time of their median
    size : [px] mean height in the images
    place : (3,) [m] median position of the body's centre
    returns : the person's absences, with the odds of each re-identification
    maybe : indices of other people that left before this one came and may be the same
    image_of : index of the person whose mirror image this is
    """

    chosen: tuple[NDArray, ...]
    views: NDArray
    confidence: float
    speed: float
    size: float
    place: NDArray
    returns: tuple[Return, ...] = ()
    maybe: tuple[int, ...] = ()
    image_of: int | None = None


def views_needed(cameras: int) -> int:
    """Number of cameras that must detect a person: three, two in rigs of two or three, one with a single camera."""
    return 3 if cameras > 3 else min(cameras, 2)


def may_be_several(keypoints: Sequence[Keypoints]) -> bool:
    """Whether records have enough detections, for long enough, for two people."""
    frames = min((len(k) for k in keypoints), default=0)
    of_camera: dict[str, NDArray] = {}
    for k in keypoints:
        count = (association.confidences(k, frames) > 0).sum(axis=1)
        of_camera[k.camera] = np.maximum(of_camera.get(k.camera, 0), count)
    people_count = np.sum([np.minimum(count, 2) for count in of_camera.values()], axis=0)
    enough = people_count >= 2 * views_needed(len(of_camera))
    return bool(frames) and np.sum(enough) >= min_person_frames(keypoints, frames)


def min_person_frames(keypoints: Sequence[Keypoints], frames: int) -> float:
    """Least number of frames with a person in a take of `frames`: a second, or half of a short take.

    Of records whose detector skipped images, as many of these as it looked at.
    """
    looked = min(1.0 if k.looked is None else float(k.looked[:frames].mean()) for k in keypoints)
    return looked * min(_MIN_PRESENCE_S * keypoints[0].rate, 0.5 * frames)


def people_of(rig: Rig, keypoints: Sequence[Keypoints], images: ImageSource | None = None) -> list[PersonTrack]:
    """Track all people that enough cameras (`views_needed`) detect for a second, in order of decreasing confidence.

    Parameters
    ----------
    rig : of the cameras
    keypoints : records with the same number of frames and rate, each of one or several people
    images : of the cameras, for re-identification by colour; default: by size only
    """
    if not keypoints:
        return []
    sets = [k.names for k in keypoints]
    main_set = max(sets, key=lambda names: (names != MEDIAPIPE_478, sets.count(names)))
    main = list({k.camera: q for q, k in reversed(list(enumerate(keypoints))) if k.names == main_set}.values())
    search = _Search(rig, [keypoints[q] for q in main])
    for f in range(search.frames):
        search.forward(f)
    for f in reversed(range(search.frames)):
        search.backward(f)
    needed, min_frames = search.needed, min_person_frames(search.keypoints, search.frames)
    spans = [PresenceSpan(t.nodes, t.path) for t in search.tracks]
    people: list[tuple[PersonTrack, Chain]] = []
    for chain in link_spans(rig, search.keypoints, spans, needed, images):
        views = np.zeros(search.frames, int)
        chosen = [np.full(search.frames, -1) for _ in keypoints]
        for f, nodes in chain.span.nodes.items():
            views[f] = len(nodes)
            for q, p in nodes:
                chosen[main[q]][f] = p
        if np.sum(views >= needed) >= min_frames:
            people.append((search.summarize(chain, chosen, views), chain))
    people.sort(key=lambda track: -track[0].confidence)
    index_of = {k: i for i, (_, chain) in enumerate(people) for k in chain.members}
    found = []
    for i, (track, chain) in enumerate(people):
        maybe = {index_of[k] for k in chain.maybe if k in index_of} - {i}
        found.append(replace(track, maybe=tuple(sorted(maybe))))
    for q in set(range(len(keypoints))) - set(main):
        source = next((r for r in main if keypoints[r].camera == keypoints[q].camera), None)
        if source is not None:
            chosen = [track.chosen[source] for track in found]
            indices = association.match_by_boxes(chosen, keypoints[source], keypoints[q])
            for track, places in zip(found, indices):
                track.chosen[q][:] = places
    return found


@dataclass(eq=False)
class _OpenTrack:
    """The track of one person during the search."""

    x: NDArray  # (k, 3) [m] last known points
    v: NDArray  # (k, 3) [m] a frame
    last: int  # last frame with a detection
    born: int
    last_met: int  # last frame with two or more cameras
    nodes: dict[int, list[Node]] = field(default_factory=dict)
    path: dict[int, NDArray] = field(default_factory=dict)

    def expected(self, frame: int) -> NDArray:
        """(k, 3) [m] predicted points: constant velocity for one frame, then constant position."""
        return self.x + self.v if abs(frame - self.last) == 1 else self.x

    def extend(self, frame: int, nodes: list[Node], x: NDArray | None, reach: float) -> None:
        """Add the detections of a frame, with points (k, 3) [m] if they were triangulated; reach: [m] per frame."""
        self.nodes[frame] = nodes
        if x is None:  # one view gives no position: the motion slows down
            self.x, self.v, self.last = self.expected(frame), 0.5 * self.v, frame
            self.path[frame] = self.x
            return
        motion = x - self.x
        middle = association.medians(motion.T) if np.isfinite(motion).all(axis=1).any() else np.zeros(3)
        x = np.where(np.isfinite(x), x, self.x + middle)
        step = (x - self.x) / max(abs(frame - self.last), 1)
        step *= np.minimum(1.0, reach / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))
        self.v = np.nan_to_num(0.5 * self.v + 0.5 * step)
        self.x, self.last, self.last_met = x, frame, frame
        self.path[frame] = x


class _Search:
    """Search for all people in the records of one keypoint set."""

    def __init__(self, rig: Rig, keypoints: Sequence[Keypoints]) -> None:
        self.rig, self.keypoints = rig, keypoints
        self.frames = min(len(k) for k in keypoints)
        self.rate = keypoints[0].rate
        self.scores = [association.suppress_duplicates(k, association.confidences(k, self.frames)) for k in keypoints]
        self.cameras = [rig[k.camera] for k in keypoints]
        self.tracks: list[_OpenTrack] = []
        self.needed = views_needed(len({k.camera for k in keypoints}))
        names = keypoints[0].names
        some = association.some_columns(len(names))
        mirrored = [names.index(m) if (m := mirror_name(names[k])) in names else k for k in some]
        self.uv, self.swapped_uv = ([_visible_points(k, columns) for k in keypoints] for columns in (some, mirrored))
        self.pairs = {
            (i, j): rig.select((a.camera, b.camera))
            for i, a in enumerate(keypoints) for j, b in enumerate(keypoints[i + 1 :], start=i + 1)
            if a.camera != b.camera
        }  # fmt: skip

    def unassigned(self, frame: int) -> list[Node]:
        """Unassigned detections of a frame, in order of decreasing confidence."""
        taken = {node for track in self.tracks for node in track.nodes.get(frame, ())}
        order = [(float(s[frame, p]), q, int(p)) for q, s in enumerate(self.scores) for p in np.flatnonzero(s[frame])]
        return [(q, p) for _, q, p in sorted(order, reverse=True) if (q, p) not in taken]

    def forward(self, frame: int) -> None:
        """Continue tracks in a frame, recover lost ones nearby, and start new ones."""
        recent = [t for t in self.tracks if frame - t.last <= MAX_SHORT_ABSENCE_S * self.rate]
        self._continue_tracks(frame, recent)
        new = self._new_people(frame)
        away = [t for t in recent if len(t.nodes.get(frame, ())) < 2]  # a single view counts as none
        cost = np.array([[_distance(t.x, x) for _, x in new] for t in away]).reshape(len(away), len(new))
        reach = np.array([association.MAX_STEP + association.MAX_SPEED * (frame - t.last) / self.rate for t in away])
        cost[cost > reach[:, None]] = np.inf
        recovered = {k: away[i] for i, k in association.assign(cost)}
        for k, (nodes, x) in enumerate(new):
            track = recovered.get(k)
            if track is None:
                track = _OpenTrack(x, np.zeros_like(x), frame, frame, frame)
                self.tracks.append(track)
            else:
                track.x, track.v, track.last = x, np.zeros_like(x), frame
            track.extend(frame, nodes, x, association.MAX_SPEED / self.rate)

    def _new_people(self, frame: int) -> list[tuple[list[Node], NDArray]]:
        """Unassigned detections that agree on a new person, and its points (k, 3) [m].

        Two people of similar height may agree in two views: groups with more views, then with a better fit come first.
        """
        available = self.unassigned(frame)
        if len({self.keypoints[q].camera for q, _ in available}) < self.needed:
            return []
        full = len(self.keypoints) * len(self.keypoints[0].names)
        ranked: list[tuple[int, float, int, list[Node], NDArray]] = []
        links = association.link_views(self.pairs, [uv[frame] for uv in self.uv], available)
        for group in association.group_views(available, links, self.scores, frame, full):
            nodes, x = self._consistent_views(frame, list(group.nodes), None)
            if x is not None and len(nodes) >= self.needed and not self._is_tracked(frame, x):
                worst = max(self._view_error(x, n, self.uv[n[0]][frame, n[1]]) for n in nodes)
                ranked.append((-len(nodes), worst, len(ranked), nodes, x))
        found: list[tuple[list[Node], NDArray]] = []
        for *_, nodes, x in sorted(ranked, key=lambda r: r[:3]):
            if not any(node in taken for taken, _ in found for node in nodes):
                found.append((nodes, x))
        return found

    def backward(self, frame: int) -> None:
        """Extend tracks to frames before enough cameras saw the person."""
        for track in self.tracks:
            if track.born == frame + 1:
                track.x, track.v = track.path[track.born], np.zeros_like(track.x)
                track.last = track.last_met = track.born
        candidates = [t for t in self.tracks if t.born > frame and t.last - frame <= self.rate]
        self._continue_tracks(frame, candidates)

    def _continue_tracks(self, frame: int, tracks: Sequence[_OpenTrack]) -> None:
        """Assign detections to tracks, camera by camera, and reject inconsistent views."""
        available, views, sides = self.unassigned(frame), [list[Node]() for _ in tracks], set[Node]()
        expected, view_costs = [t.expected(frame) for t in tracks], dict[Node, float]()
        for q in range(len(self.cameras)):
            detections = [p for r, p in available if r == q]
            if not detections or not tracks:
                continue
            both = np.concatenate([self.uv[q][frame, detections], self.swapped_uv[q][frame, detections]])
            errors = association.distances(self.cameras[q], np.array(expected), both)
            direct, swapped = errors[:, : len(detections)], errors[:, len(detections) :]
            swapped[np.isinf(direct)] = np.inf  # too few points
            cost = np.minimum(direct, swapped)
            waited = np.array([abs(frame - t.last) for t in tracks])
            speed = association.MAX_SPEED / _ASSUMED_STATURE
            near = np.minimum(_MAX_DETECTION_DISTANCE + speed * waited / self.rate, 0.5)
            cost[cost > near[:, None]] = np.inf
            for t, p in association.assign(cost, 0.6):
                views[t].append((q, detections[p]))
                view_costs[q, detections[p]] = float(cost[t, p])
                if swapped[t, p] < direct[t, p]:
                    sides.add((q, detections[p]))
        others = [t for t in self.tracks if len(t.nodes.get(frame, ())) > 1]
        accepted = [(t.nodes[frame], t.path[frame]) for t in others]
        seen = [*zip(views, expected), *accepted]
        updates: list[tuple[bool, int, float, int, list[Node], NDArray | None]] = []
        for k in (k for k in range(len(tracks)) if views[k]):
            gap = abs(frame - tracks[k].last_met)
            reach = _MAX_PAIR_STEP + association.MAX_SPEED * gap / self.rate
            kept, found = self._consistent_views(frame, views[k], expected[k], sides, reach)
            cost_k = view_costs[kept[0]] if found is None else _distance(found, expected[k])
            if found is None and cost_k > _MAX_LONE_VIEW_ERROR:
                unseen = [x for own, x in seen if kept[0][0] not in {q for q, _ in own}]
                if any(_distance(expected[k], x) < 2.0 * association.MAX_STEP for x in unseen):
                    continue  # it may be of another person nearby, unseen by this camera
            updates.append((found is None, gap, cost_k, k, kept, found))
        for _, _, _, k, kept, found in sorted(updates, key=lambda one: one[:4]):
            new = accepted[len(others) :]
            lone = found is None and any(_distance(expected[k], place) < association.MAX_STEP for _, place in new)
            if lone or any(self._is_same_person(frame, kept, found, *other, sides) for other in accepted):
                continue  # duplicate detections of another person: two bodies cannot share a place
            tracks[k].extend(frame, kept, found, association.MAX_SPEED / self.rate)
            if found is not None:
                accepted.append((kept, found))

    def _is_same_person(
        self, frame: int, nodes: list[Node], x: NDArray | None, kept: list[Node], at: NDArray, sides: Collection[Node],
    ) -> bool:  # fmt: skip
        """Whether a track's views show the person of another track at `at` (k, 3) [m]: all views agree together."""
        if x is None:
            q, p = nodes[0]
            uv = (self.swapped_uv if nodes[0] in sides else self.uv)[q][frame, p]
            return self._view_error(at, nodes[0], uv) <= _MAX_VIEW_ERROR
        distance, cameras = _distance(x, at), {q for q, _ in kept}
        added = [node for node in nodes if node[0] not in cameras]
        if distance < _MIN_PERSON_DISTANCE or distance > 2.0 * association.MAX_STEP or not added:
            return distance < _MIN_PERSON_DISTANCE
        both = [*kept, *added]
        return len(self._consistent_views(frame, both, None, sides)[0]) == len(both)

    def _view_error(self, x: NDArray, node: Node, uv: NDArray) -> float:
        """Distance of a detection's points (k, 2) [px] from points (k, 3) [m], relative to its height."""
        return float(association.distances(self.cameras[node[0]], x[None], uv[None])[0, 0])

    def _consistent_views(
        self, frame: int, nodes: list[Node], expected: NDArray | None, sides: Collection[Node] = (),
        reach: float = np.inf,
    ) -> tuple[list[Node], NDArray | None]:
        """The views that agree on one person, and its points (k, 3) [m]; None if a single view is left.

        A view is rejected if it disagrees with the others by more than 8 % of the body height in the image. Two views
        often agree by chance: their points must lie within `reach` [m] of `expected`. The detector swapped left and
        right in the views of `sides`; the fit of the body corrects that.
        """
        while len(nodes) > 1:
            each = [(self.swapped_uv if node in sides else self.uv)[node[0]][frame, node[1]] for node in nodes]
            uv = np.stack(each, axis=1)
            height = float(association.medians(association.heights(np.moveaxis(uv, 0, 1))))
            rig = self.rig.select(tuple(self.keypoints[q].camera for q, _ in nodes))
            x, _, _ = triangulate_robust(rig, uv, max_residual_px=max(1.0, _MAX_VIEW_ERROR * height))
            errors = np.array([self._view_error(x, node, own) for node, own in zip(nodes, each)])
            jumps = expected is not None and len(nodes) == 2 and _distance(x, expected) > reach
            if errors.max() <= _MAX_VIEW_ERROR and not jumps:
                return nodes, x
            if len(nodes) == 2 and expected is not None:
                errors = np.array([self._view_error(expected, node, own) for node, own in zip(nodes, each)])
            nodes = [node for i, node in enumerate(nodes) if i != int(errors.argmax())]
        return nodes, None

    def _is_tracked(self, frame: int, x: NDArray) -> bool:
        """Whether a tracked person is at these points (k, 3) [m]: then this is a duplicate detection."""
        return any(_distance(t.x, x) < _MIN_PERSON_DISTANCE for t in self.tracks if frame in t.nodes)

    def summarize(self, chain: Chain, chosen: list[NDArray], views: NDArray) -> PersonTrack:
        """Summarize a chain of spans as a person."""
        step = max(round(SPEED_INTERVAL_S * self.rate), 1)
        nodes, path = chain.span.nodes, chain.span.path
        moved = [path[f + step] - x for f, x in path.items() if f + step in path]
        sizes = [association.heights(self.uv[q][f, p]) for f, each in nodes.items() for q, p in each]
        confidence = sum(float(self.scores[q][f, p]) for f, each in nodes.items() for q, p in each)
        place = association.medians(association.medians(np.moveaxis(np.array(list(path.values())), 1, 2)).T)
        speed = float(np.mean(association.medians(np.linalg.norm(moved, axis=2)))) * self.rate / step if moved else 0.0
        return PersonTrack(tuple(chosen), views, confidence, speed, float(np.nanmean(sizes)), place, chain.returns)


def _visible_points(record: Keypoints, columns: Sequence[int] | NDArray) -> NDArray:
    """(F, P, k, 2) [px] points of a record in some columns; NaN where not visible."""
    is_visible = record.confidence[:, :, columns] > 0.1
    return np.where(is_visible[..., None], record.points[:, :, columns], np.nan)


def _distance(a: NDArray, b: NDArray) -> float:
    """[m] median distance of corresponding points (k, 3); infinite without common points."""
    d = np.linalg.norm(a - b, axis=1)
    return float(np.median(d[np.isfinite(d)])) if np.isfinite(d).any() else np.inf
