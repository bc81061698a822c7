"""Track from markers without names: identify a frame, fit the body to it with no pose given, go on (P5 5, tracking).

A tracker that is fed with `name_frame` starts by itself in the first frame that shows enough, and again wherever it
is lost: nothing but the frame itself is looked at. `start_from_markers` is the same first step alone.
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

OFF = 0.05
"""[m] median distance of named markers beyond which a pose explains none of them."""


def name_frame(
    model: MarkerModel, points: ArrayLike, time: float, *, marker_set: str, sensor: str = "markers",
    settings: IdentifySettings | None = None,
) -> MarkerFrame:
    """One frame of unlabelled points as the tracker takes it; a label that is missing or not certain is NaN.

    Parameters
    ----------
    model : of the subject, see `learn_model`
    points : (N, 3) [m], finite, in any order
    time : [s]
    marker_set : of the body that is tracked, its labels without the subject's name: `MarkerSubject.marker_set`

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite.
    """
    found = identify(model, points, settings=settings).assignment
    at = np.where(found[:, None] >= 0, np.asarray(points, float)[found], np.nan)
    return MarkerFrame(sensor, time, tuple(bare(n) for n in model.labels), at, marker_set)


def start_from_markers(subject: MarkerSubject, model: MarkerModel, points: ArrayLike) -> BodyState:
    """State of a subject's body from one frame of unlabelled points (N, 3) [m], with no pose given.

    Parameters
    ----------
    subject : body and places of its markers, see `fit_marker_subject`
    model : the same subject's, see `learn_model`

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
    state, off = pose_from_points(subject.body, subject.points, x, sigma=0.01)
    if not off < OFF:
        raise TrackingError(
            f"no pose fits the markers: they are {1e3 * off:.0f} mm off", remedy="Are model and body of one subject?"
        )
    return state
