"""All people: who is who in all cameras and over time, among everybody whom detectors saw.

Each person's points in space are carried to the next frame; in every camera people and detections are then paired at
the least total cost, and views that do not fit the others are let go. Of two whose views are all of one person, one is
nobody in that frame; so is who is seen by one camera alone, within a stride of another. Who is seen by enough cameras
and is nobody yet is a new person, or one who was lost within reach a moment ago. Whom cameras saw before enough of them
did is added backwards. Who was away for longer is known again by size, clothes and way, see `returns`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.multiview.association import SPEED, STRIDE, Node, groups_of, links_of, some_points, surety_of
from kinefit.multiview.boxes import once, same_people
from kinefit.multiview.likeness import Pictures
from kinefit.multiview.medians import distances, medians
from kinefit.multiview.returns import BRIEF, Chain, PresenceSpan, Return, chains_of
from kinefit.observations import MEDIAPIPE_478, Keypoints
from kinefit.sensors.channels import mirror_name
from kinefit.solvers.assignment import assign

_NEAR = 0.25  # a person's points and a detection differ by less, as a share of the detection's height, and by ...
_TALL = 1.7  # [m] ... how far people go from frame to frame, for one of this stature; half a height at most
_FITS = 0.08  # views of one person all lie within this share of the height; two, see association, within half of it
_LEAP = 0.05  # [m] points that two views alone tell are no farther from where somebody is expected, who hardly went on
_SAME = 0.2  # [m] points of two people are further apart than detections of one and the same
_LASTING = 1.0  # [s] for which somebody must be seen to be a person; half of a take that is shorter than two
STEP = 0.2  # [s] over which speeds are taken: in less, detectors' noise is as large as a motion


@dataclass(frozen=True, eq=False)
class PersonTrack:
    """One of the people in view.

    Parameters
    ----------
    chosen : of each record (F,) int, which of the detected it is in each frame, -1 for none
    views : (F,) how many cameras see the person
    surety : float, points seen in all frames, each as sure as the detector was
    speed : float [m/s] of the body's points, the mean over time of their median
    size : float [px] mean height in the pictures
    place : (3,) [m] median place of the body's middle
    returns : when the person was away, and how sure it is that it is the same
    maybe : numbers, in a list of people from 0, of others who left before this one came and may be the same
    image_of : number, likewise, of who shows here in a mirror
    """

    chosen: tuple[NDArray, ...]
    views: NDArray
    surety: float
    speed: float
    size: float
    place: NDArray
    returns: tuple[Return, ...] = ()
    maybe: tuple[int, ...] = ()
    image_of: int | None = None


def views_needed(cameras: int) -> int:
    """By how many cameras somebody must be seen to count as a person."""
    return 3 if cameras > 3 else min(cameras, 2)


def may_be_several(keypoints: Sequence[Keypoints]) -> bool:
    """Whether records have enough detections, for long enough, for two people to be in view."""
    frames = min((len(k) for k in keypoints), default=0)
    of_camera: dict[str, NDArray] = {}
    for k in keypoints:
        count = (surety_of(k, frames) > 0).sum(axis=1)
        of_camera[k.camera] = np.maximum(of_camera.get(k.camera, 0), count)
    two = np.sum([np.minimum(count, 2) for count in of_camera.values()], axis=0)
    enough = two >= 2 * views_needed(len(of_camera))
    return bool(frames) and np.sum(enough) >= lasting(keypoints[0].rate, frames)


def lasting(rate: float, frames: int) -> float:
    """For how many frames somebody must be seen to be a person."""
    return min(_LASTING * rate, 0.5 * frames)


def people_of(rig: Rig, keypoints: Sequence[Keypoints], pictures: Pictures | None = None) -> list[PersonTrack]:
    """Everybody whom enough cameras see for a second, the one of whom most is seen first.

    Parameters
    ----------
    rig : Rig
    keypoints : records of the same number of frames and the same rate, each of one or several people.
    pictures : of the cameras, by whose colours those who come back are known again; by their size alone without
    """
    if not keypoints:
        return []
    sets = [k.names for k in keypoints]
    usual = max(sets, key=lambda names: (names != MEDIAPIPE_478, sets.count(names)))
    main = list({k.camera: q for q, k in reversed(list(enumerate(keypoints))) if k.names == usual}.values())
    search = _Search(rig, [keypoints[q] for q in main])
    for f in range(search.frames):
        search.forward(f)
    for f in reversed(range(search.frames)):
        search.backward(f)
    needed, long = search.needed, lasting(keypoints[0].rate, search.frames)
    spans = [PresenceSpan(t.nodes, t.path) for t in search.tracks]
    people: list[tuple[PersonTrack, Chain]] = []
    for chain in chains_of(rig, search.keypoints, spans, needed, pictures):
        views = np.zeros(search.frames, int)
        chosen = [np.full(search.frames, -1) for _ in keypoints]
        for f, nodes in chain.span.nodes.items():
            views[f] = len(nodes)
            for q, p in nodes:
                chosen[main[q]][f] = p
        if np.sum(views >= needed) >= long:
            people.append((search.person(chain, chosen, views), chain))
    people.sort(key=lambda one: -one[0].surety)
    number = {k: i for i, (_, chain) in enumerate(people) for k in chain.members}
    found = []
    for i, (one, chain) in enumerate(people):
        maybe = {number[k] for k in chain.maybe if k in number} - {i}
        found.append(replace(one, maybe=tuple(sorted(maybe))))
    for q in set(range(len(keypoints))) - set(main):
        own = next((r for r in main if keypoints[r].camera == keypoints[q].camera), None)
        if own is not None:
            there = same_people([one.chosen[own] for one in found], keypoints[own], keypoints[q])
            for one, places in zip(found, there):
                one.chosen[q][:] = places
    return found


@dataclass(eq=False)
class _OpenTrack:
    """One person while the search goes on."""

    x: NDArray  # (k, 3) [m] last known points
    v: NDArray  # (k, 3) [m] a frame
    last: int  # frame in which it was seen, and ...
    born: int
    met: int  # ... in which by two cameras or more
    nodes: dict[int, list[Node]] = field(default_factory=dict)
    path: dict[int, NDArray] = field(default_factory=dict)

    def expected(self, frame: int) -> NDArray:
        """(k, 3) [m] points at a frame: on their way for one frame, then where they were."""
        return self.x + self.v if abs(frame - self.last) == 1 else self.x

    def seen(self, frame: int, nodes: list[Node], x: NDArray | None, reach: float) -> None:
        """Go on with detections, and points (k, 3) where they could be triangulated."""
        self.nodes[frame] = nodes
        if x is None:  # one view tells no place in space: slowly to a halt
            self.x, self.v, self.last = self.expected(frame), 0.5 * self.v, frame
            self.path[frame] = self.x
            return
        moved = x - self.x
        middle = medians(moved.T) if np.isfinite(moved).all(axis=1).any() else np.zeros(3)
        x = np.where(np.isfinite(x), x, self.x + middle)
        step = (x - self.x) / max(abs(frame - self.last), 1)
        step *= np.minimum(1.0, reach / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))
        self.v = np.nan_to_num(0.5 * self.v + 0.5 * step)
        self.x, self.last, self.met = x, frame, frame
        self.path[frame] = x


class _Search:
    """Everybody in the records of one detector."""

    def __init__(self, rig: Rig, keypoints: Sequence[Keypoints]) -> None:
        self.rig, self.keypoints = rig, keypoints
        self.frames = min(len(k) for k in keypoints)
        self.rate = keypoints[0].rate
        self.surety = [once(k, surety_of(k, self.frames)) for k in keypoints]
        self.cameras = [rig[k.camera] for k in keypoints]
        self.tracks: list[_OpenTrack] = []
        self.needed = views_needed(len({k.camera for k in keypoints}))
        names = keypoints[0].names
        some = some_points(len(names))
        mirrored = [names.index(m) if (m := mirror_name(names[k])) in names else k for k in some]
        self.uv, self.exchanged = ([_seen(k, columns) for k in keypoints] for columns in (some, mirrored))
        self.pairs = {
            (i, j): rig.select((a.camera, b.camera))
            for i, a in enumerate(keypoints) for j, b in enumerate(keypoints[i + 1 :], start=i + 1)
            if a.camera != b.camera
        }  # fmt: skip

    def free(self, frame: int) -> list[Node]:
        """Detections of a frame that nobody has, the surest first."""
        taken = {node for track in self.tracks for node in track.nodes.get(frame, ())}
        ranked = [(float(s[frame, p]), q, int(p)) for q, s in enumerate(self.surety) for p in np.flatnonzero(s[frame])]
        return [(q, p) for _, q, p in sorted(ranked, reverse=True) if (q, p) not in taken]

    def forward(self, frame: int) -> None:
        """Who goes on, who comes back and who is new in a frame."""
        near = [t for t in self.tracks if frame - t.last <= BRIEF * self.rate]
        self._go_on(frame, near)
        came = self._newcomers(frame)
        away = [t for t in near if len(t.nodes.get(frame, ())) < 2]  # one view is as good as none
        cost = np.array([[_apart(t.x, x) for _, x in came] for t in away]).reshape(len(away), len(came))
        reach = np.array([STRIDE + SPEED * (frame - t.last) / self.rate for t in away])
        cost[cost > reach[:, None]] = np.inf
        back = {k: away[i] for i, k in assign(cost)}
        for k, (nodes, x) in enumerate(came):
            track = back.get(k)
            if track is None:
                track = _OpenTrack(x, np.zeros_like(x), frame, frame, frame)
                self.tracks.append(track)
            else:
                track.x, track.v, track.last = x, np.zeros_like(x), frame
            track.seen(frame, nodes, x, SPEED / self.rate)

    def _newcomers(self, frame: int) -> list[tuple[list[Node], NDArray]]:
        """Detections that are of one person whom nobody has yet, and its points (k, 3) [m].

        Two people of like height fit each other in two views: the most views go first, then those that fit best.
        """
        free = self.free(frame)
        if len({self.keypoints[q].camera for q, _ in free}) < self.needed:
            return []
        full = len(self.keypoints) * len(self.keypoints[0].names)
        ranked: list[tuple[int, float, int, list[Node], NDArray]] = []
        links = links_of(self.pairs, [uv[frame] for uv in self.uv], free)
        for group in groups_of(free, links, self.surety, frame, full):
            nodes, x = self._agreeing(frame, list(group.nodes), None)
            if x is not None and len(nodes) >= self.needed and not self._is_there(frame, x):
                worst = max(self._off(x, n, self.uv[n[0]][frame, n[1]]) for n in nodes)
                ranked.append((-len(nodes), worst, len(ranked), nodes, x))
        came: list[tuple[list[Node], NDArray]] = []
        for *_, nodes, x in sorted(ranked, key=lambda r: r[:3]):
            if not any(node in taken for taken, _ in came for node in nodes):
                came.append((nodes, x))
        return came

    def backward(self, frame: int) -> None:
        """Who was there before enough cameras saw it."""
        for track in self.tracks:
            if track.born == frame + 1:
                track.x, track.v = track.path[track.born], np.zeros_like(track.x)
                track.last = track.met = track.born
        early = [t for t in self.tracks if t.born > frame and t.last - frame <= self.rate]
        self._go_on(frame, early)

    def _go_on(self, frame: int, tracks: Sequence[_OpenTrack]) -> None:
        """Pair people with detections, camera by camera."""
        free, views, sides = self.free(frame), [list[Node]() for _ in tracks], set[Node]()
        expected = [t.expected(frame) for t in tracks]
        for q in range(len(self.cameras)):
            mine = [p for r, p in free if r == q]
            if not mine or not tracks:
                continue
            both = np.concatenate([self.uv[q][frame, mine], self.exchanged[q][frame, mine]])
            off = distances(self.cameras[q], np.array(expected), both)
            as_is, turned = off[:, : len(mine)], off[:, len(mine) :]
            turned[np.isinf(as_is)] = np.inf  # too little is seen to tell
            cost = np.minimum(as_is, turned)
            waited = np.array([abs(frame - t.last) for t in tracks])
            near = np.minimum(_NEAR + SPEED / _TALL * waited / self.rate, 0.5)
            cost[cost > near[:, None]] = np.inf
            for t, p in assign(cost, 0.6):
                views[t].append((q, mine[p]))
                if turned[t, p] < as_is[t, p]:
                    sides.add((q, mine[p]))
        each: list[tuple[int, float, int, list[Node], NDArray | None]] = []
        for k in (k for k in range(len(tracks)) if views[k]):
            unmet = abs(frame - tracks[k].met)
            kept, found = self._agreeing(frame, views[k], expected[k], sides, _LEAP + SPEED * unmet / self.rate)
            each.append((unmet, np.inf if found is None else _apart(found, expected[k]), k, kept, found))
        placed: list[tuple[list[Node], NDArray]] = []
        for _, _, k, kept, found in sorted(each, key=lambda one: one[:3]):
            lone = found is None and any(_apart(expected[k], place) < STRIDE for _, place in placed)
            if lone or any(self._is_one(frame, kept, found, *other, sides) for other in placed):
                continue  # other detections of somebody who is there: no two bodies stand in one place
            tracks[k].seen(frame, kept, found, SPEED / self.rate)
            if found is not None:
                placed.append((kept, found))

    def _is_one(
        self, frame: int, nodes: list[Node], x: NDArray | None, others: list[Node], place: NDArray,
        sides: Collection[Node],
    ) -> bool:  # fmt: skip
        """Whether views of a track are of another one's person, who has points (k, 3) [m]: all agree together."""
        if x is None:
            q, p = nodes[0]
            return self._off(place, nodes[0], (self.exchanged if nodes[0] in sides else self.uv)[q][frame, p]) <= _FITS
        apart, cameras = _apart(x, place), {q for q, _ in others}
        more = [node for node in nodes if node[0] not in cameras]
        if apart < _SAME or apart > 2.0 * STRIDE or not more:
            return apart < _SAME
        both = [*others, *more]
        return len(self._agreeing(frame, both, None, sides)[0]) == len(both)

    def _off(self, x: NDArray, node: Node, uv: NDArray) -> float:
        """How far a detection's points (k, 2) [px] are from points (k, 3), as a share of its height."""
        return float(distances(self.cameras[node[0]], x[None], uv[None])[0, 0])

    def _agreeing(
        self, frame: int, nodes: list[Node], expected: NDArray | None, sides: Collection[Node] = (),
        reach: float = np.inf,
    ) -> tuple[list[Node], NDArray | None]:
        """The views that are of one person, and its points (k, 3) [m]; None where a single one is left.

        Two views alone agree on much that is nobody: their points must lie within `reach` [m] of those expected.
        Of those in `sides` left is taken for right: the detector did so, which the fit of the person sets right.
        """
        while len(nodes) > 1:
            each = [(self.exchanged if node in sides else self.uv)[node[0]][frame, node[1]] for node in nodes]
            uv = np.stack(each, axis=1)
            height = float(medians(np.nanmax(uv[..., 1], axis=0) - np.nanmin(uv[..., 1], axis=0)))
            rig = self.rig.select(tuple(self.keypoints[q].camera for q, _ in nodes))
            x, _, _ = triangulate_robust(rig, uv, max_residual_px=max(_FITS * height, 1.0))
            off = np.array([self._off(x, node, own) for node, own in zip(nodes, each)])
            leapt = expected is not None and len(nodes) == 2 and _apart(x, expected) > reach
            if off.max() <= _FITS and not leapt:
                return nodes, x
            if len(nodes) == 2 and expected is not None:
                off = np.array([self._off(expected, node, own) for node, own in zip(nodes, each)])
            nodes = [node for i, node in enumerate(nodes) if i != int(off.argmax())]
        return nodes, None

    def _is_there(self, frame: int, x: NDArray) -> bool:
        """Whether somebody stands at these very points: a second detection of one person is no other."""
        return any(_apart(t.x, x) < _SAME for t in self.tracks if frame in t.nodes)

    def person(self, chain: Chain, chosen: list[NDArray], views: NDArray) -> PersonTrack:
        """What is told of a person."""
        step = max(round(STEP * self.rate), 1)
        nodes, path = chain.span.nodes, chain.span.path
        moved = [path[f + step] - x for f, x in path.items() if f + step in path]
        sizes = [np.ptp(uv[np.isfinite(uv)]) for uv in (
            self.uv[q][f, p, :, 1] for f, each in nodes.items() for q, p in each
        )]  # fmt: skip
        sure = sum(float(self.surety[q][f, p]) for f, each in nodes.items() for q, p in each)
        place = medians(medians(np.moveaxis(np.array(list(path.values())), 1, 2)).T)
        speed = float(np.mean(medians(np.linalg.norm(moved, axis=2)))) * self.rate / step if moved else 0.0
        return PersonTrack(tuple(chosen), views, sure, speed, float(np.mean(sizes)), place, chain.returns)


def _seen(record: Keypoints, columns: Sequence[int] | NDArray) -> NDArray:
    """(F, P, k, 2) [px] some points of a record; NaN where they are not seen."""
    sure = record.confidence[:, :, columns] > 0.1
    return np.where(sure[..., None], record.points[:, :, columns], np.nan)


def _apart(a: NDArray, b: NDArray) -> float:
    """[m] median distance of points (k, 3) from their likes; infinite where none is in both."""
    d = np.linalg.norm(a - b, axis=1)
    return float(np.median(d[np.isfinite(d)])) if np.isfinite(d).any() else np.inf
