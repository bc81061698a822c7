"""What every sensor is: prepare, match, rows; checks of what one of a user returns.

A `Sensor` lives for a whole take. It turns each frame into a `Measurement`. `match` decides everything discrete
(correspondences, visibility, sides) and freezes it; the resulting `Matched` gives linearised rows at any state:

    sensor.prepare(frame, scene) -> measurement.match(scene, reach) -> matched.rows(scene)

`rows` is a pure function of the scene. So a solver can compare the costs of trial states, and a subject fit can
differentiate with respect to the body: it asks for the rows of the same match with a slightly different body. A match
must therefore refer to what every body with the same segments has: a landmark's name, a surface's own coordinates.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError
from kinefit.sensors import _kernels
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, MIN_VISIBLE_OUTLINE, Evidence
from kinefit.sensors.scene import Scene, Unknown
from kinefit.sensors.surfaces.depth_view import DepthSeen, DepthView
from kinefit.solving.least_squares import PixelPoints
from kinefit.solving.rows import AnyRows, DofRows, PairRows, ParameterRows, Rows, less_sure


def of_kind(value: object, kind: type, what: str, remedy: str, *, each: type | None = None) -> None:
    """Raise ObservationError if a value, called `what`, is text or not of a kind, or an item not of `each`."""
    if not isinstance(value, kind) or isinstance(value, str):
        raise ObservationError(f"{what} is a {type(value).__name__}, not a {kind.__name__}", remedy=remedy)
    if each is not None:
        for item in value.values() if isinstance(value, Mapping) else value:  # type: ignore[attr-defined]
            of_kind(item, each, f"one of {what}", remedy)


@contextmanager
def named(sensor: str) -> Iterator[None]:
    """Context in which every ObservationError raised names the sensor."""
    try:
        yield
    except ObservationError as error:
        if sensor in str(error):
            raise
        raise ObservationError(f"sensor '{sensor}': {error.problem}", remedy=error.remedy) from error


def check_rows(rows: Any, sensor: str, body: Body) -> list[AnyRows]:
    """Check the rows of a user's own sensor; errors name the sensor.

    Raises
    ------
    ObservationError
        No rows; of wrong shapes, not finite, of negative weight; on segments or degrees of freedom that the body does
        not have.
    """
    parts = [rows] if isinstance(rows, AnyRows) else rows
    if not isinstance(parts, Sequence) or not all(isinstance(p, AnyRows) for p in parts):
        kinds = type(rows).__name__
        remedy = "`rows` must return Rows, PairRows, ParameterRows or DofRows, or a list of them."
        raise ObservationError(f"`rows` of sensor '{sensor}' returned a {kinds}", remedy=remedy)
    count, n = len(body.tree.segments), body.tree.n_dofs
    for p in parts:
        if isinstance(p, Rows) and not p.segment.shape == p.group.shape == p.data.shape[1:] == (p.data.size // 8,):
            shapes = p.data.shape, p.segment.shape, p.group.shape
            raise ObservationError(f"sensor '{sensor}' has rows of shapes {shapes}", remedy="Create them with Rows.of.")
        if isinstance(p, Rows) and _kernels.sound(p.data, p.segment, count):
            continue
        if isinstance(p, Rows) and not math.isfinite(p.data.sum()):
            remedy = "Leave out rows that were not measured."
            raise ObservationError(f"sensor '{sensor}' has rows that are not finite", remedy=remedy)
        if p.weight.ndim == 1 and len(p) and p.weight.min() < 0.0:
            raise ObservationError(f"sensor '{sensor}' has rows of negative weight", remedy="Weights are 1/σ².")
        used = p.segments if isinstance(p, PairRows) else p.index if isinstance(p, ParameterRows) else p.segment
        what, most = ("degree of freedom", n) if isinstance(p, ParameterRows) else ("segment", count)
        if used is not None and used.size and not 0 <= used.min() <= used.max() < most:
            wrong = int(used.min() if used.min() < 0 else used.max())
            problem = f"sensor '{sensor}' has rows on {what} {wrong}; body '{body.name}' has {most}"
            raise ObservationError(problem, remedy="Use body.tree.segment(name), or the segments of a point set.")
        if isinstance(p, DofRows) and not callable(p.by_dof) and p.jacobian.shape[1] != n:
            problem = f"sensor '{sensor}' has a jacobian of {p.jacobian.shape[1]} columns; body '{body.name}' has {n}"
            raise ObservationError(problem, remedy="Give one column for each degree of freedom.")
    return list(parts)


@dataclass(frozen=True, eq=False)
class Hints:
    """Points and views from which a pose can be found without a prediction.

    Parameters
    ----------
    points, x_world : PointSet of K points of the body, and where they are (K, 3) [m]; NaN where that is unknown.
    rays : (K, 2, 3) origin [m] and unit direction in the world of the ray on which each point lies; NaN where unknown.
    view : DepthView in which to search for a person or a limb.
    """

    points: PointSet | None = None
    x_world: NDArray | None = None
    rays: NDArray | None = None
    view: DepthView | None = None


@dataclass(frozen=True, eq=False)
class Leftover:
    """Residuals of one measurement after the fit, of each point or of each segment.

    Parameters
    ----------
    label : name under which a report has it: a camera's, a marker system's
    names : (K,) of the points, or of the segments
    segments : (K,) int
    values : (K, N) measured minus fitted, N = 2 [px] or 3 [m]; of segments the signed median, N = 1; NaN if unobserved
    weights : (K,) robust weight in 0..1; 0 if unobserved
    unit : "px" or "m"
    measured : (K, N) the measurements as used; NaN for segments
    swapped : whether left and right were exchanged
    rms, count : (K,) of the residuals of each segment; None for points
    """

    label: str
    names: tuple[str, ...]
    segments: NDArray
    values: NDArray
    weights: NDArray
    unit: str
    measured: NDArray
    swapped: bool = False
    rms: NDArray | None = None
    count: NDArray | None = None


class Matched(ABC):
    """A measurement with its correspondences.

    Attributes
    ----------
    sensor, time : name of the sensor, and when [s] it measured; those of the measurement where they are not set
    added : variances that unknowns of the sensor add to each part of its rows, once they are computed
    of_points : whether rows are single points with independent errors; else the rows of one segment err alike.
    shows_surface : whether it shows a surface as a whole, so that a missing surface contradicts the body.
    lasts : share 0..1 of a point's stated variance that is systematic, and so does not average out over time
    sigma_known : whether the stated standard deviation holds, and is not estimated from the residuals of a take
    independent : whether channels err independently, so that residuals show the systematic share
    turns : {segment: (3,) [rad] in its frame}, standard deviation of the rotation of a segment's measured surface about
        its bone, the same for the whole take
    places : (M,) set and name of the body's points that these channels are of, "" for landmarks. Give it only if each
        row is the offset of its point and depends on the body by that point alone: a subject fit is faster with it.
    cameras : (M,) number in the rig of the camera that sees each of these points; empty if none does.
    """

    sensor: str = ""
    time: float = np.nan
    added: Sequence[NDArray] | None = None
    of_points: bool = True
    shows_surface: bool = False
    lasts: float = 0.0
    sigma_known: bool = False
    independent: bool = False
    turns: Mapping[int, NDArray] = MappingProxyType({})
    places: Sequence[tuple[str, str]] | None = None
    cameras: NDArray | None = None

    @property
    def key(self) -> bytes:
        """Equal for matches that make the same rows: a fit has converged once it no longer changes."""
        return b""

    @property
    def channels(self) -> Sequence[str] | None:
        """(M,) names, each once, of what the measurement ids of its rows (`Rows.group`; without ids, each row) are of.

        Such as a marker, or a keypoint in a camera: a name means the same channel in every frame.
        By default those of `places`. None numbers the channels: ids then must be the same whenever there are rows.
        Where `of_points` is False, segments are the channels.
        """
        return None if self.places is None else [f"{of} {name}" if of else name for of, name in self.places]

    def moves(self, scene: Scene) -> NDArray | None:
        """(D,) bool: coordinates that move what it shows by more than sensors err; None if its rows alone tell."""
        return None

    def packed(self, scene: Scene) -> PixelPoints | None:
        """Its points, if it is pixels alone: such a frame is fitted by one compiled kernel."""
        return None

    @abstractmethod
    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Rows at a scene's state, a pure function of the scene; weights without the loss, which each kind carries."""

    def squares(self, scene: Scene) -> NDArray:
        """(M,) squared residual of each point, in variances; by default of each group of rows."""
        return np.concatenate([np.zeros(0), *(np.array([s for _, s in _groups(r)]) for r in felt(self, scene))])

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Residuals after the fit; by default the signed median, RMS and number of rows of each segment [m]."""
        residual, segment = [np.zeros(0)], [np.zeros(0, np.int64)]
        for rows in self.rows(scene):
            for segments in _segments(rows):
                felt = rows.weight > 0.0
                residual, segment = [*residual, rows.residual[felt]], [*segment, segments[felt]]
        return [by_segments(self.sensor, scene.body, np.concatenate(residual), np.concatenate(segment), "m")]

    def evidence(self, scene: Scene) -> Evidence:
        """Evidence on each segment; by default every group of rows supports its segments or contradicts them."""
        out = np.zeros((2, len(scene.body.tree.segments)))
        for rows in felt(self, scene):
            for segments, square in _groups(rows):
                out[int(square >= AGREEMENT_SIGMAS**2), list(segments)] += MIN_VISIBLE_OUTLINE
        return Evidence(*out)


class Measurement(ABC):
    """What one sensor saw at one time.

    Attributes
    ----------
    sensor : name of the sensor
    time : float [s]
    settled : whether a match depends on the state only in what is discrete (labels, sides), so that the fit may go to
        its minimum under one match. False for nearest points, which change at every step.
    within : float [m] bound on the distance of the body from its prediction; inf if the sensor knows none
    """

    sensor: str
    time: float
    settled: bool = True
    within: float = np.inf

    @abstractmethod
    def match(self, scene: Scene, reach: float) -> Matched:
        """Correspondences at a scene's state, up to a correspondence distance [m]."""

    def hints(self, scene: Scene) -> Hints:
        """Points and views for a search without a predicted pose."""
        return Hints()

    def starts(self, scene: Scene, information: NDArray | None, evidence: Evidence) -> Sequence[BodyState]:
        """Alternative start states for a fit, from a sensor that searches; none by default.

        Parameters
        ----------
        scene : at the predicted state
        information : (n, n) of the prediction; None without one
        evidence : of this measurement on the state that the fit found from the prediction
        """
        return ()

    def better(self, new: Scene, old: Scene) -> bool | None:
        """Whether a fit from one of the `starts` replaces the state found before; None: the evidence decides."""
        return None

    def depth_image(self) -> DepthSeen | None:
        """A depth image in which other sensors look up occlusions; None without one."""
        return None

    def doubt(self, segments: NDArray) -> None:  # noqa: B027
        """Mark segments (S,) bool that an unexplained object may be; see `Evidence.unplaced`."""

    def compact(self) -> Measurement:
        """A small copy for the smoother, without whole images."""
        return self


class Sensor(ABC):
    """A source of measurements for a whole take: its noise, its clock, its learnt state.

    Attributes
    ----------
    name : as frames name it in `sensor`
    unknowns : {name: Unknown} of its own that a subject fit estimates
    together : whether `prepare` takes a list of all its frames of one time, in place of one frame
    places_points : whether a measurement's `hints` locate named points of the body in any pose
    shows_person : whether it shows a whole person, so that a search in it takes long
    follows : whether its data are in a frame of their own, which the poses by other sensors place
    state_attributes : names of the attributes that change while it tracks; checkpoints keep those of kinefit's sensors
    """

    name: str
    unknowns: Mapping[str, Unknown] = {}
    together: bool = False
    places_points: bool = False
    shows_person: bool = False
    follows: bool = False
    state_attributes: Sequence[str] = ()

    @abstractmethod
    def prepare(self, frame: Any, scene: Scene) -> Measurement:
        """The measurement of one frame, ready to be matched; the scene has the body at its prediction."""

    def person_size(self, body: Body) -> tuple[float, float] | None:
        """Size of the person as a share of a body's and the standard deviation of its logarithm; None if it has none.

        Beside markers and one camera it counts in place of the rows, which then tell poses, but no lengths.
        """
        return None

    def learn(self, measurement: Any, scene: Scene, sure: bool) -> None:  # noqa: B027
        """Learn from an accepted step; `sure` if no segment is lost.

        Replace learnt attributes, do not change them in place: if another sensor of the step fails, the attributes of
        this one are set back. Put what a later match needs into the measurement: smoothing matches it again.
        """


@dataclass(frozen=True, eq=False)
class RowsOf(Matched):
    """A match made of one function from scenes to rows.

    Parameters
    ----------
    make : scene -> rows
    about : its further arguments
    labels : array, optional; the discrete part of the match, such as the name of each point: its `key`
    channels : names of the rows' measurement ids, see `Matched`
    """

    make: Any
    about: Mapping[str, Any] = field(default_factory=dict)
    labels: ArrayLike | None = None
    channels: Sequence[str] | None = None  # type: ignore[override]

    @property
    def key(self) -> bytes:
        """Equal for equal labels."""
        return b"" if self.labels is None else np.asarray(self.labels).tobytes()

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Rows as the function returns them."""
        made: AnyRows | Sequence[AnyRows] = self.make(scene, **self.about)
        return [made] if isinstance(made, AnyRows) else made


def matched_by(measurement: Measurement, scene: Scene, reach: float) -> Matched:
    """Match a measurement at the time at which it was taken, up to a correspondence distance `reach` [m].

    Raises
    ------
    ObservationError
        The sensor's `match` returned no `Matched`.
    """
    with named(measurement.sensor):
        matched = measurement.match(scene.at_time(measurement.time), reach)
    what = f"the result of `match` of sensor '{measurement.sensor}'"
    of_kind(matched, Matched, what, "It must return a Matched, such as RowsOf(function).")
    if not matched.sensor:
        object.__setattr__(matched, "sensor", measurement.sensor)
    object.__setattr__(matched, "time", measurement.time)
    return matched


def rows_at(matched: Matched, scene: Scene) -> Sequence[AnyRows]:
    """Checked rows of a match, the body moved to the time of the measurement; see `check_rows` for errors."""
    with named(matched.sensor):
        return felt(matched, scene.at_time(matched.time), check=True)


def felt(matched: Matched, scene: Scene, *, check: bool = False) -> Sequence[AnyRows]:
    """Rows of a match; unknowns of its sensor that have no estimate add their variance, where it was matched, to each.

    Parameters
    ----------
    check : whether the rows are checked, see `check_rows` for errors
    """

    def made(at: Scene) -> Sequence[AnyRows]:
        rows = matched.rows(at)
        return check_rows(rows, matched.sensor, scene.body) if check else rows

    rows, known = made(scene), scene.values.get(matched.sensor, {})
    open_ones = {name: u for name, u in scene.unknowns.get(matched.sensor, {}).items() if name not in known}
    if not open_ones:
        return rows
    if matched.added is None:
        added = [np.zeros(len(part)) for part in rows]
        for name, unknown in open_ones.items():
            values = {**scene.values, matched.sensor: {**known, name: unknown.mean + unknown.std}}
            moved = made(scene.at(scene.state, values=values))
            added = [v + np.square(b.residual - a.residual) for v, a, b in zip(added, rows, moved, strict=True)]
        object.__setattr__(matched, "added", added)
    return [less_sure(part, v) for part, v in zip(rows, matched.added or (), strict=True)]


def packed(matched: Sequence[Matched], scene: Scene) -> PixelPoints | None:
    """The points of a scene's only match for a fit in one compiled kernel; None where rows are needed."""
    return matched[0].packed(scene) if len(matched) == 1 and scene.at_time(matched[0].time) is scene else None


def leftovers_at(matched: Matched, scene: Scene) -> list[Leftover]:
    """Residuals of a match after the fit, the body moved to the time of the measurement."""
    return matched.leftovers(scene.at_time(matched.time))


def by_segments(label: str, body: Body, residual: NDArray, segment: NDArray, unit: str) -> Leftover:
    """Median, RMS and number of residuals (N,) [unit] of points on segments (N,), for each segment."""
    count = np.bincount(segment, minlength=len(body.tree.segments))
    some, before = count > 0, np.cumsum(count) - count
    line = residual[np.lexsort((residual, segment))]
    median, rms = np.full(len(count), np.nan), np.full(len(count), np.nan)
    median[some] = 0.5 * (line[(before + (count - 1) // 2)[some]] + line[(before + count // 2)[some]])
    rms[some] = np.sqrt(np.bincount(segment, residual**2, len(count))[some] / count[some])
    names, nothing = body.tree.segments, np.full((len(count), 1), np.nan)
    every = np.arange(len(count))
    weights = some.astype(float)
    return Leftover(label, names, every, median[:, None], weights, unit, nothing, rms=rms, count=count)


def _groups(rows: AnyRows) -> list[tuple[set[int], float]]:
    """Segments and squared residual, in variances, of each measurement in some rows."""
    segments = _segments(rows)
    if isinstance(rows, ParameterRows) or not segments:
        return []
    felt = rows.weight > 0.0
    group = np.full(len(rows), -1) if isinstance(rows, PairRows) else rows.group
    ids = np.where(group < 0, group.max(initial=-1) + 1 + np.arange(len(rows)), group)[felt]
    square = np.bincount(ids, (rows.weight * rows.residual**2)[felt])
    return [({int(s) for of in segments for s in of[felt][ids == i]}, float(square[i])) for i in np.unique(ids)]


def _segments(rows: AnyRows) -> list[NDArray]:
    """(N,) segments that rows are about: one each, two of pairs, none of rows on degrees of freedom."""
    if isinstance(rows, PairRows):
        return [rows.segments[:, 0], rows.segments[:, 1]]
    of = None if isinstance(rows, ParameterRows) else rows.segment
    return [] if of is None else [of]
