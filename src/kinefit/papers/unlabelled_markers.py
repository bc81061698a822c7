"""Track unlabelled markers: identify each frame, and fit the body to it without a given pose (P5 5, tracking).

`sapm_take` labels every frame of a take by SAPM as published, with the same result as `identify_take`.

A tracker with input from `name_frame` initialises in the first sufficient frame, and again when it is lost, because
each frame is identified by itself. `start_from_markers` is the initialisation alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit._arguments import checked
from kinefit.bodies import BodyState
from kinefit.bodies.marker_sets import bare
from kinefit.errors import ObservationError, TrackingError
from kinefit.fitting.initialization.from_points import pose_from_points
from kinefit.fitting.markers.subject import MarkerSubject
from kinefit.markers.frame.identify import IdentifySettings, identify
from kinefit.markers.model.model import MarkerModel
from kinefit.markers.take.naming import Step
from kinefit.markers.take.takes import TakeIdentification, TakeSettings, judge_labels
from kinefit.observations import MarkerFrame, Markers
from kinefit.papers.sapm import sapm

MAX_START_ERROR = 0.05
"""[m] median distance of labelled markers from the body in an initial pose."""


def name_frame(
    model: MarkerModel, points: ArrayLike, time: float, *, marker_set: str, sensor: str = "markers",
    settings: IdentifySettings | None = None,
) -> MarkerFrame:
    """Label one frame of unlabelled points for the tracker; missing or uncertain labels are NaN.

    Parameters
    ----------
    model : of the subject, see `learn_model`
    points : (N, 3) [m], finite, in any order
    time : float [s]
    marker_set : of the tracked body, with labels without the subject's name: `MarkerSubject.marker_set`

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite.
    """
    found = identify(model, points, settings=settings).assignment
    at = np.where(found[:, None] >= 0, np.asarray(points, float)[found], np.nan)
    return MarkerFrame(sensor, time, tuple(bare(n) for n in model.labels), at, marker_set)


def start_from_markers(subject: MarkerSubject, model: MarkerModel, points: ArrayLike) -> BodyState:
    """Estimate the state of a subject's body from one frame of unlabelled points (N, 3) [m], without an initial pose.

    Parameters
    ----------
    subject : body and positions of its markers, see `fit_marker_subject`
    model : of the same subject, see `learn_model`

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite.
    TrackingError
        Fewer than six labels are certain, or no pose of the body fits them.
    """
    frame = name_frame(model, points, 0.0, marker_set=subject.marker_set)
    x = np.full((len(subject.points), 3), np.nan)
    for k, name in enumerate(subject.points.names):
        if name in frame.names:
            x[k] = frame.positions[frame.names.index(name)]
    state, error = pose_from_points(subject.body, subject.points, x, sigma=0.01)
    if not error < MAX_START_ERROR:
        raise TrackingError(
            f"no pose fits the markers: they are {1e3 * error:.0f} mm off", remedy="Use model and body of one subject."
        )
    return state


@checked
def sapm_take(
    model: MarkerModel, markers: Markers, *, settings: TakeSettings | None = None, progress: Step | None = None,
    epsilon: float = 0.1, beta: float = 0.8,
) -> TakeIdentification:
    """Label all points of a take by `sapm`, every frame anew.

    The paper states no probability of a match. So confidence and doubts come only from the distances of each label to
    its neighbours, as in `identify_take`.

    Parameters
    ----------
    settings : gaps to fill and the least confidence without doubt; its anchors are not used
    progress : (what, done, total) -> None
    epsilon, beta : see `sapm`

    Raises
    ------
    ObservationError
        No frame has a match.
    """
    settings = settings or TakeSettings()
    column = np.full((len(markers), len(model)), -1)
    visible = np.isfinite(markers.positions).all(-1)
    for f in range(len(markers)):
        seen = np.flatnonzero(visible[f])
        match = sapm(model, markers.positions[f, seen], epsilon=epsilon, beta=beta)
        column[f] = np.where(match >= 0, np.append(seen, -1)[match], -1)
        if progress is not None:
            progress("matching", f + 1, len(markers))
    if (column < 0).all():
        raise ObservationError(
            f"SAPM matches no segment of {model.name} in any frame", file=markers.source or None,
            remedy="Check that subject, markers and unit are the same; with missing points lower beta.",
        )
    at = np.where((column >= 0)[..., None], markers.positions[np.arange(len(markers))[:, None], column], np.nan)
    everywhere = tuple(range(len(markers)))
    return judge_labels(
        model, at, column, np.ones(column.shape), markers.rate, settings, everywhere, int(visible.sum())
    )
