"""Track unlabelled markers: identify each frame, and fit the body to it without a given pose (P5 5, tracking).

A tracker with input from `name_frame` initialises in the first sufficient frame, and again when it is lost, because
each frame is identified by itself. `start_from_markers` is the initialisation alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import BodyState
from kinefit.bodies.marker_sets import bare
from kinefit.errors import TrackingError
from kinefit.identification.frame.identify import IdentifySettings, identify
from kinefit.identification.model.model import MarkerModel
from kinefit.initialization.from_points import pose_from_points
from kinefit.markers.subject import MarkerSubject
from kinefit.observations import MarkerFrame

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
