"""Labelled markers of one file to a motion: `track` with one marker sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body
from kinefit.bodies.marker_sets import find_placement
from kinefit.bodies.motion import Motion
from kinefit.fitting.markers.poses import columns
from kinefit.fitting.markers.subject import MarkerSubject
from kinefit.fitting.subject.subject import Progress, Subject
from kinefit.fitting.tracking.motions import Estimation
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.session import axis_of
from kinefit.fitting.tracking.sizing import SizedPerson
from kinefit.fitting.tracking.video import motion_of_person
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import Loss
from kinefit.observations import Markers, NamedMarkers
from kinefit.sensors.settings import MARKER_LOSS, TrackSettings

_SENSOR = "markers"


@checked
def fit_markers(
    body: Body | MarkerSubject,
    markers: Markers,
    marker_set: str | PathLike[str] | None = None,
    *,
    sigma: float | NDArray | Sequence[float] | None = None,
    loss: Loss = MARKER_LOSS,
    limits: bool = True,
    up: str | None = None,
    smooth: bool = True,
    progress: Progress | None = None,
) -> Motion:
    """Motion of a body of the subject's size from labelled markers, without an initial pose: `track` of them alone.

    Parameters
    ----------
    body : MarkerSubject or Body
        From `fit_marker_subject`, with set, sigma and the uncertainty of lengths and marker offsets. A body of the
        subject's size with its marker offsets counts as exact: standard deviations are then too small.
    markers : Markers
        (F, N, 3) [m]. Labels outside of the set are excluded; prefix ("Anna:LASI"), case and punctuation are ignored.
    marker_set : str
        Default: the subject's; of a body the set that shares most labels, the body's own sets first.
    sigma : scalar or (K,) [m], standard deviation of each marker of the set along each axis
        Default: the subject's; of a body 5 mm.
    loss : Loss of a marker, robust to wrong labels and ghosts
    limits : whether joint limits hold
    up : vertical axis of the world; default: the file's, or else the axis along which the body stands
    smooth : whether all frames are fitted together with a motion prior; otherwise each on its own
    progress : called with (what, done, total)

    Raises
    ------
    ObservationError
        The body knows fewer than four of the labels.
    TrackingError
        No frame shows enough markers to start from.
    """
    known = body if isinstance(body, MarkerSubject) else None
    body = body if isinstance(body, Body) else body.body
    if known is not None and marker_set in (None, known.marker_set):
        marker_set, sigma = known.marker_set, known.sigma if sigma is None else sigma
    placement = find_placement(body, markers.names, marker_set)
    points, stated = placement.points, np.asarray(TrackSettings().marker if sigma is None else sigma, float)
    if stated.ndim and marker_set is not None and len(stated) != len(points):
        labels = body.marker_sets.get(str(marker_set), points)
        stated = stated[[labels.index(n) for n in points.names]]
    each = dict(zip((f"{_SENSOR} {name}" for name in points.names), np.broadcast_to(stated, len(points)).tolist()))
    worn = NamedMarkers(
        _SENSOR, replace(markers, names=points.names, positions=columns(markers, points.names), residual=None),
        placement.name,
    )  # fmt: skip
    fitted = replace(body, marker_sets={placement.name: points, **body.marker_sets})
    fitted = fitted if limits else fitted.without_limits()
    recording = Recording(
        markers.times, markers.rate, Rig(()), steps=lambda i: [worn.at(float(markers.times[i]))], sigma=each,
        markers=(worn,), up=up or markers.up or "z", name=Path(markers.source).stem or "markers",
    )  # fmt: skip
    person = SizedPerson(recording, Subject.as_is(fitted))
    if known is not None:
        person = person.with_markers(known, fitted)
    motion = motion_of_person(
        person, TrackSettings(marker_loss=loss), Estimation(smooth=smooth), each=not smooth, progress=progress
    )
    up = up or markers.up or axis_of(motion.Ts_world_root[:, :3, 1].mean(axis=0))
    return replace(motion, body=body, up=up, plates=markers.plates, events=markers.events)
