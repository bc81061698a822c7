"""Check the labels of markers against the body: exchanged sides, a mirrored world, labels exchanged in pairs.

A body of average shape with the set's marker places is fitted to some frames as they are labelled, and once more to
their mirror image. Places and lengths are not fitted: with them, a mirrored person fits to a few millimetres. Exchanged
sides and a mirrored world give the same fit, and both together give the same angles as neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.marker_sets import MarkerPlacement, find_placement, ignored_labels, side_pairs
from kinefit.errors import ObservationError, shortened
from kinefit.findings import Finding
from kinefit.fitting.initialization.from_points import pose_from_points
from kinefit.fitting.markers.subject import columns, first_size
from kinefit.observations import Markers

_MAX_FRAMES = 24  # spread over the take
_MIN_VISIBLE_SHARE = 0.7  # of the most markers that any frame shows
_MIN_MARKERS = 6  # of a frame that is fitted
_BODY_SIGMA = 0.02  # [m] of a place on a body of the person's size and of average proportions
_MAX_SQUARE = 100.0  # of a marker's distance in sigmas: a wrong label has no further pull

_MIN_MIRROR_RATIO = 1.5
"""Ratio of the misfits of a take and of its mirror image from which one of them is right.

The right one's ratio is 2.4 to 5.0 in the labelled takes of `markers` (walks, squats, jumps, dances, a sprint), on
which this was chosen, and 2.7 to 6.3 in the others (benchmark `faults_sides`); 1.0 where labels say nothing of sides.
"""
_MAX_MISFIT = 3.0  # sigmas of the better fit, the root mean square: 0.1 to 2.0 where labels are right
_MIN_ONE_SIDED_GAIN = 4.0  # sum of squares by which markers of one side decide: one of 4 cm sigma, 16 cm off, has 12

_MIN_PAIR_GAIN = 3.0
"""Sum of squares of a frame by which the exchange of a left and a right label lowers the misfit: at least 4 where they
are exchanged (markers of the sternum, 5 cm apart), at most -4 where they are right."""
_MIN_OTHER_GAIN = 30.0
"""The same of two other labels: 47 and more of exchanged heel and toe, knee and ankle, at most 19 where they are right
(markers about the shoulder, whose places laboratories choose)."""
_MIN_GROUP_MISFIT = 1.4  # sigmas, from which all labels of the legs, or of the rest, are tried
_MIN_FRAME_SHARE = 0.8  # of the frames, in which the exchange is better
_MAX_PAIRS = 4  # that are named
_MAX_TRIALS = 6  # exchanges that are fitted, those with most gain at the poses found

_OTHER = ("a mirrored world", "exchanged labels")  # the cause that markers of one side exclude, by their gain's sign
_LEGS = ("thigh", "shank", "foot", "toes", "talus")


@checked
def label_findings(
    body: Body, markers: Markers, marker_set: str | PathLike[str] | MarkerPlacement | None = None, *,
    sides: str | None = None,
) -> tuple[Finding, ...]:  # fmt: skip
    """Find exchanged sides or a mirrored world ("sides"), and labels that are exchanged in the whole take ("labels").

    Notes name the marker set where it ignores labels, and say where the labels do not decide about the sides.

    Parameters
    ----------
    body : Body with left and right segments, of any size
    markers : labelled, of one person, (F, N, 3) [m]
    marker_set : see `bodies.marker_sets.find_placement`
    sides : "labelled" if the user has confirmed the sides, which are then not checked

    Returns
    -------
    Findings, faults first; none about the sides of bodies and labels without sides

    Raises
    ------
    ObservationError
        Too few labels are known, or the unit gives an impossible size.
    """
    placed = find_placement(body, markers.names, marker_set)
    notes: list[Finding] = []
    if ignored := ignored_labels(placed, markers.names):
        count = len(placed.points)
        text = f"Marker set {placed.name}: {count} of {count + len(ignored)} labels; ignored: {', '.join(ignored)}."
        notes.append(Finding("note", "labels", shortened(text)))
    trial = _trial(body, markers, placed)
    if trial is None or not trial.pairs:
        return tuple(notes)
    mirrored = replace(trial, x=trial.x * [1.0, 1.0, -1.0])
    ratio = float(np.median(trial.misfits / mirrored.misfits))
    if ratio > _MIN_MIRROR_RATIO and np.median(mirrored.misfits) < _MAX_MISFIT:
        return tuple(notes) if sides == "labelled" else (_sides_fault(trial, mirrored, markers.up), *notes)
    found = [*_exchanged_labels(trial)]
    if not found and 1.0 / ratio < _MIN_MIRROR_RATIO:
        text = f"Left and right are undecided: the {len(trial.points)} known labels fit their mirror image as well."
        remedy = "Mark knees, heels and toes to have them checked, or compare with what was recorded."
        notes.append(Finding("note", "sides", text, (), "", remedy))
    return (*found, *notes)


def refuse_wrong_sides(findings: tuple[Finding, ...]) -> None:
    """Raise an ObservationError if the findings of `label_findings` have exchanged sides or a mirrored world."""
    for found in findings:
        if (found.severity, found.kind) == ("fault", "sides"):
            raise ObservationError(found.text.rstrip("."), remedy=found.remedy)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A body of the person's size in some frames: K points with sigma (K,) [m], and where they were seen (F, K, 3)."""

    body: Body
    points: PointSet
    sigma: NDArray
    x: NDArray

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of right labels and of their left ones."""
        return [(self.points.index(a), self.points.index(b)) for a, b in side_pairs(self.points.names).items()]

    @cached_property
    def states(self) -> list[BodyState]:
        """The body in each frame, fitted without initial pose."""
        return [pose_from_points(self.body, self.points, x, sigma=self.sigma)[0] for x in self.x]

    @property
    def roots(self) -> NDArray:
        """(F, 4, 4) [m] T_world_root of the states."""
        return np.stack([state.T_world_root for state in self.states])

    @cached_property
    def places(self) -> NDArray:
        """(F, K, 3) [m] where the fitted body has the points."""
        return self.body.trajectories(self.roots, np.stack([s.angles for s in self.states]), self.points)

    @cached_property
    def squares(self) -> NDArray:
        """(F,) sum of the squared distances in sigmas, each bounded, as if every point was seen."""
        off = np.minimum(np.square((self.x - self.places) / self.sigma[:, None]).sum(axis=2), _MAX_SQUARE)
        return np.asarray(np.nanmean(off, axis=1) * off.shape[1])

    @property
    def misfits(self) -> NDArray:
        """(F,) root mean square of the distances in sigmas."""
        return np.sqrt(self.squares / len(self.points))

    def exchanged(self, pairs: list[tuple[int, int]]) -> _Trial:
        """The same with pairs of labels exchanged."""
        order = np.arange(len(self.points))
        for a, b in pairs:
            order[[a, b]] = b, a
        return replace(self, x=self.x[:, order])


def _trial(body: Body, markers: Markers, placed: MarkerPlacement) -> _Trial | None:
    """Some well visible frames on a body of the person's size; None if no frame shows enough."""
    x = columns(markers, placed.points.names)
    seen = np.isfinite(x).all(axis=2)
    ever = seen.any(axis=0)
    placed, x = placed.select(n for n, here in zip(placed.points.names, ever) if here), x[:, ever]
    count = seen.sum(axis=1)
    good = np.flatnonzero(count >= max(_MIN_MARKERS, _MIN_VISIBLE_SHARE * count.max(initial=0)))
    if not len(good):
        return None
    frames = good[np.unique(np.linspace(0, len(good) - 1, _MAX_FRAMES).astype(int))]
    size = first_size(body, placed, x)
    points = replace(placed.points, points=placed.points.points * size)
    scaled = body.scaled(np.full(len(body.scale_groups), size))
    return _Trial(scaled, points, np.hypot(placed.spread, _BODY_SIGMA), x[frames])


def _sides_fault(trial: _Trial, mirrored: _Trial, up: str | None) -> Finding:
    """The finding of exchanged sides or a mirrored world, with what decides between them, and what mends either."""
    mends = {
        "the world is mirrored (left-handed)": f"export it right-handed, or --sides mirrored-{_sideways(mirrored, up)}",
        "left and right labels are exchanged": "correct them, or --sides exchanged",
    }
    gain = float(np.median(trial.exchanged(trial.pairs).squares - mirrored.squares))
    paired = {k for pair in trial.pairs for k in pair}
    lateral = np.abs(trial.body.points_rest(trial.points)[:, 2]) > _BODY_SIGMA
    single = [n for k, n in enumerate(trial.points.names) if lateral[k] and k not in paired]
    why = "Markers alone do not tell which; joint angles are the same with either remedy."
    if single and abs(gain) > _MIN_ONE_SIDED_GAIN:
        mends.pop([*mends][gain > 0.0])
        why = f"Markers without a counterpart ({', '.join(single)}) decide between this and {_OTHER[gain > 0.0]}."
    before, after = float(np.median(trial.misfits)), float(np.median(mirrored.misfits))
    text = (
        f"{' or '.join(mends).capitalize()}: the body fits {before / after:.1f} times better in a mirror ({before:.1f} "
        f"and {after:.1f} sigmas, {len(trial.points)} labels, {len(trial.x)} frames)."
    )
    remedy = "; ".join(f"if {cause}: {mend}" for cause, mend in mends.items())
    remedy = f'{remedy[0].upper()}{remedy[1:]} (in a take: sides = "..." in [[markers]]). "labelled" keeps all.'
    return Finding("fault", "sides", text, (), why, remedy)


def _sideways(trial: _Trial, up: str | None) -> str:
    """The horizontal world axis nearest to the person's left-right axis: negated, it keeps vertical and direction."""
    axes = np.abs(trial.roots[:, :3, :3]).mean(axis=0)
    axes[int(np.argmax(axes[:, 1])) if up is None else "xyz".index(up[-1]), 2] = -1.0
    return "xyz"[int(np.argmax(axes[:, 2]))]


def _exchanged_labels(trial: _Trial) -> Iterator[Finding]:
    """Pairs of labels, or all of the legs, or all others, whose exchange makes the body fit much better."""
    segments = [trial.body.tree.segments[s] for s in trial.points.segments]
    legs = [p for p in trial.pairs if segments[p[0]].startswith(_LEGS)]
    groups = {"legs": legs, "upper body": [p for p in trial.pairs if p not in legs]}
    groups = groups if np.median(trial.misfits) > _MIN_GROUP_MISFIT else {}
    for _ in range(_MAX_PAIRS):
        names = {f"Left and right labels of the {what} are": pairs for what, pairs in groups.items() if len(pairs) > 1}
        names |= {f"{trial.points.names[a]} and {trial.points.names[b]} are": [(a, b)] for a, b in _promising(trial)}
        best: tuple[float, str, _Trial] | None = None
        for who, pairs in names.items():
            other = trial.exchanged(pairs)
            gains = trial.squares - other.squares
            gain = float(np.median(gains))
            least = _MIN_PAIR_GAIN if set(pairs) <= set(trial.pairs) else _MIN_OTHER_GAIN
            clear = gain > least * len(pairs) and np.mean(gains > 0.0) >= _MIN_FRAME_SHARE
            if clear and (best is None or gain > best[0]):
                best = gain, who, other
        if best is None:
            return
        before, after = (float(np.median(t.misfits)) for t in (trial, best[2]))
        text = f"{best[1]} exchanged in the whole take: the body is {before:.2f} sigmas off, {after:.2f} without."
        yield Finding("fault", "labels", text, (), "", "Exchange the labels in the file, and run this again.")
        trial = best[2]


def _promising(trial: _Trial) -> list[tuple[int, int]]:
    """Pairs of labels whose exchange lowers the misfit most at the poses found, (a, b) with a right label first."""
    off = np.square((trial.x[:, :, None] - trial.places[:, None]) / trial.sigma[:, None]).sum(axis=3)
    off = np.minimum(off, _MAX_SQUARE)  # (F, seen, place)
    own = np.einsum("fkk->fk", off)
    gains = np.median(np.nan_to_num(own[:, :, None] + own[:, None] - off - off.transpose(0, 2, 1)), axis=0)
    most = np.argsort(-np.triu(gains, 1), axis=None)[:_MAX_TRIALS]
    found = [divmod(int(k), len(own[0])) for k in most if gains.flat[k] > _MIN_PAIR_GAIN / 2]
    return [p if p in trial.pairs or p[::-1] not in trial.pairs else p[::-1] for p in found]
