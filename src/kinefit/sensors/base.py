"""What every kind of sensor is to the tracker, the smoother and the subject fit: three short classes.

A `Sensor` lives for a whole take. At one time it makes a `Measurement` of what it saw; the measurement is matched to
the body (correspondences, visibility, sides: discrete, then frozen), and what is `Matched` gives rows at any state:

    sensor.prepare(frame, scene) -> measurement.match(scene, reach) -> matched.rows(scene)

`rows` is a pure function of the scene. That is what lets a solver compare costs of trial states, and a subject fit
differentiate by anything of the body: it asks for the rows of the same match again, with a body that is a little
different. So whatever a match refers to must have a meaning on any body of the same make: a landmark's name, a
surface's own coordinates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.rows import AnyRows, PairRows, ParameterRows
from kinefit.sensors.checks import check_rows, named, of_kind
from kinefit.sensors.evidence import AGREES, SHOWN, Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.surfaces.depth_view import DepthView

if TYPE_CHECKING:
    from kinefit.sensors.points.keypoints import KeypointMatched
    from kinefit.sensors.visibility.occlusion import DepthSeen


@dataclass(frozen=True)
class Unknown:
    """Something of a sensor that is not known beforehand, such as a rope's length.

    Parameters
    ----------
    mean, std : float, what is thought of it before anything is measured: in metres, radians, seconds, pixels.
    """

    mean: float
    std: float


@dataclass(frozen=True, eq=False)
class Hints:
    """What a measurement shows of the body where nothing is known of its pose.

    Parameters
    ----------
    points, x_world : PointSet of K points of the body, and where they are (K, 3) [m]; NaN where that is unknown.
    rays : (K, 2, 3) origin [m] and unit direction in the world of the ray on which each point lies; NaN where unknown.
    view : what a limb, or a person, can be sought in.
    """

    points: PointSet | None = None
    x_world: NDArray | None = None
    rays: NDArray | None = None
    view: DepthView | None = None


@dataclass(frozen=True, eq=False)
class Leftover:
    """What the fit leaves over of one measurement, point by point or segment by segment.

    Parameters
    ----------
    label : name under which a report has it: a camera's, a marker system's
    names : (K,) of the points, or of the segments
    segments : (K,) int
    values : (K, N) measured minus fitted, N = 2 [px] or 3 [m]; of segments the signed median, N = 1; NaN where unseen
    weights : (K,) robust weight in 0..1; 0 where unseen
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
    of_points : whether its rows are single points, each with errors of its own; else those of one segment err alike.
    shows_surface : whether it shows a surface as a whole, and so what is not where it should be.
    lasts : share 0..1 of a point's stated variance that lasts, and so does not average out over time
    independent : whether each channel errs by itself in it, so that residuals show how much lasts
    turns : {segment: (3,) [rad] in its frame}, one standard deviation by which all that it says of a segment's surface
        is turned against the bone, for as long as the take lasts
    places : (M,) set and name of the body's points that these channels are of, "" for landmarks, where every row
        says how far its point is off and depends on the body by that point alone; a subject fit is quicker with it.
    cameras : (M,) number in the rig of the camera that sees each of these points; empty where none does.
    """

    sensor: str = ""
    time: float = np.nan
    of_points: bool = True
    shows_surface: bool = False
    lasts: float = 0.0
    independent: bool = False
    turns: Mapping[int, NDArray] = MappingProxyType({})
    places: Sequence[tuple[str, str]] | None = None
    cameras: NDArray | None = None

    @property
    def pixels(self) -> KeypointMatched | None:
        """Its points in images as one packed block, or None: compiled fits and the smoother take such a block whole."""
        return None

    @property
    def key(self) -> bytes:
        """The same for matches that make the same rows: what shows a fit that nothing discrete changes any more."""
        return b""

    @property
    def channels(self) -> Sequence[str] | None:
        """(M,) names, each once, of what the measurement ids of its rows (`Rows.group`; without ids, each row) are of.

        Such as a marker, or a keypoint in a camera: a name means the same all through the take, whatever else is seen.
        By default those of `places`. None numbers the channels: ids then must be the same whenever there are rows.
        Where `of_points` is False, segments are the channels.
        """
        return None if self.places is None else [f"{of} {name}" if of else name for of, name in self.places]

    @abstractmethod
    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Rows at a scene's state: a pure function of the scene, not softened, each kind with its loss."""

    def squares(self, scene: Scene) -> NDArray:
        """(M,) squared residual of each of its points, in variances; by default of each group of rows."""
        return np.concatenate([np.zeros(0), *(np.array([s for _, s in _groups(r)]) for r in self.rows(scene))])

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """What the fit leaves over; by default of each segment the rows' signed median, RMS and number [m]."""
        residual, segment = [np.zeros(0)], [np.zeros(0, np.int64)]
        for rows in self.rows(scene):
            for segments in _segments(rows):
                felt = rows.weight > 0.0
                residual, segment = [*residual, rows.residual[felt]], [*segment, segments[felt]]
        return [by_segments(self.sensor, scene.body, np.concatenate(residual), np.concatenate(segment), "m")]

    def evidence(self, scene: Scene) -> Evidence:
        """What it says of each segment; by default every group of rows speaks for its segments, or against them."""
        out = np.zeros((2, len(scene.body.tree.segments)))
        for rows in self.rows(scene):
            for segments, square in _groups(rows):
                out[int(square >= AGREES**2), list(segments)] += SHOWN
        return Evidence(*out)


class Measurement(ABC):
    """What one sensor saw at one time.

    Attributes
    ----------
    sensor : name of the sensor
    time : float [s]
    settled : whether a match depends on the state only in what is discrete (labels, sides), so that the fit may go to
        its minimum under one match. False for nearest points, which are sought anew at every step.
    within : float [m] how far at most the body is from where it is expected, as far as the sensor knows
    """

    sensor: str
    time: float
    settled: bool = True
    within: float = np.inf

    @abstractmethod
    def match(self, scene: Scene, reach: float) -> Matched:
        """Correspondences at a scene's state, within a distance [m]."""

    def hints(self, scene: Scene) -> Hints:
        """What it shows where no pose is known."""
        return Hints()

    def starts(self, scene: Scene, information: NDArray | None, told: Evidence) -> Sequence[BodyState]:
        """Other states that a fit may as well begin at; a sensor that searches gives some where they are of use.

        Parameters
        ----------
        scene : where the body is expected
        information : (n, n) of that, None where nothing was known
        told : what this measurement says of the state that was found from there
        """
        return ()

    def better(self, new: Scene, old: Scene) -> bool | None:
        """Whether a fit that began at one of the `starts` is to be taken in place of what was found.

        None for a sensor that knows no better than the sum of what all sensors' evidence says.
        """
        return None

    def depth_image(self) -> DepthSeen | None:
        """A depth image that other sensors may ask what is in front of something."""
        return None

    def doubt(self, segments: NDArray) -> None:  # noqa: B027
        """Know of segments (S,) bool that may be what no part of the body explains; see `Evidence.unplaced`."""

    def compact(self) -> Measurement:
        """What a smoother keeps of it: no whole images."""
        return self


class Sensor(ABC):
    """A sensor for the whole of a take: its noise, its clock, what it has learnt.

    Attributes
    ----------
    name : as frames name it in `sensor`
    unknowns : {name: Unknown} of its own that a subject fit estimates
    together : whether `prepare` takes a list of all its frames of one time, in place of one frame
    places_points : whether a measurement says in its `hints` where named points of the body are, whatever the pose
    shows_person : whether it shows a person as a whole, so that a search for one in it takes long
    state_attributes : names of the attributes that change while it tracks; checkpoints keep those of kinefit's sensors
    """

    name: str
    unknowns: Mapping[str, Unknown] = {}
    together: bool = False
    places_points: bool = False
    shows_person: bool = False
    state_attributes: Sequence[str] = ()

    @abstractmethod
    def prepare(self, frame: Any, scene: Scene) -> Measurement:
        """What it saw at one time, ready to be matched; the scene has the body where it is expected."""

    def learn(self, measurement: Any, scene: Scene, sure: bool) -> None:  # noqa: B027
        """Learn from a step that was accepted; `sure` where no segment is lost.

        Replace what was learnt, rather than change it in place: where another sensor of the step fails, the attributes
        of this one are set back. What a later match needs belongs into the measurement: smoothing sees it as it was.
        """


@dataclass(frozen=True, eq=False)
class RowsOf(Matched):
    """A match that is no more than a function from scenes to rows.

    Parameters
    ----------
    make : scene -> rows
    about : further arguments of it
    labels : array, optional; what is discrete of the match, such as which point has which name: its `key`
    channels : names of the rows' measurement ids, see `Matched`
    """

    make: Any
    about: Mapping[str, Any] = field(default_factory=dict)
    labels: ArrayLike | None = None
    channels: Sequence[str] | None = None  # type: ignore[override]

    @property
    def key(self) -> bytes:
        """The same for the same labels."""
        return b"" if self.labels is None else np.asarray(self.labels).tobytes()

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """As the function makes them."""
        made: AnyRows | Sequence[AnyRows] = self.make(scene, **self.about)
        return [made] if isinstance(made, AnyRows) else made


def pixels_of(matched: Iterable[Matched]) -> list[KeypointMatched]:
    """The packed blocks of those matches that offer one."""
    return [block for m in matched if (block := m.pixels) is not None]


def matched_by(measurement: Measurement, scene: Scene, reach: float) -> Matched:
    """A measurement, matched; a match that names no sensor is the measurement's.

    Raises
    ------
    ObservationError
        What a sensor's `match` gave is no match.
    """
    with named(measurement.sensor):
        matched = measurement.match(scene.at_time(measurement.time), reach)
    what = f"what `match` of sensor '{measurement.sensor}' gave"
    of_kind(matched, Matched, what, "It must return a Matched, such as RowsOf(function).")
    if not matched.sensor:
        object.__setattr__(matched, "sensor", measurement.sensor)
    object.__setattr__(matched, "time", measurement.time)
    return matched


def rows_at(matched: Matched, scene: Scene) -> list[AnyRows]:
    """Rows of a match, with the body where it is at the time of the measurement; see `check_rows` for errors."""
    with named(matched.sensor):
        rows = matched.rows(scene.at_time(matched.time))
    return check_rows(rows, matched.sensor, scene.body)


def leftovers_at(matched: Matched, scene: Scene) -> list[Leftover]:
    """What the fit leaves over of a match, with the body where it is at the time of the measurement."""
    return matched.leftovers(scene.at_time(matched.time))


def by_segments(label: str, body: Body, residual: NDArray, segment: NDArray, unit: str) -> Leftover:
    """Residuals (N,) of points on segments (N,), segment by segment."""
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
