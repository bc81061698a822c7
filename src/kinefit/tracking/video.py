"""From 2D keypoints of calibrated cameras to a motion: the main job."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import ObservationError, TrackingError
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion, Residuals
from kinefit.multiview.association import choose_people
from kinefit.observations import Keypoints
from kinefit.sensors.channels import Channels, make_channels
from kinefit.smoothing.smoother import smooth_results
from kinefit.smoothing.uncertainty import with_lasting_errors
from kinefit.subject.keypoints import Progress, Subject, fit_subject
from kinefit.tracking.interrupted import TrackingInterrupted
from kinefit.tracking.tracker import FrameResult, Settings, Tracker


def track(
    rig: Rig,
    keypoints: Sequence[Keypoints],
    body: Body,
    *,
    accuracy: float | Sequence[float] = 8.0,
    subject: Subject | None = None,
    trial: Subject | None = None,
    height: float | None = None,
    settings: Settings | None = None,
    smooth: bool = True,
    contacts: bool = False,
    shape_frames: int = 25,
    up: str = "z",
    name: str = "motion",
    progress: Progress | None = None,
) -> Motion:
    """Motion of one person from keypoints of several calibrated cameras, with no pose given.

    The person is chosen among all detected, bone lengths are found from frames spread over the take, then every frame
    is fitted straight to the pixels, with outliers and exchanged sides set right and error bars from the normal matrix.

    Parameters
    ----------
    rig : Rig
    keypoints : records of the same number of frames and the same rate.
    body : Body, generic.
    accuracy : [px] standard deviation of a sure keypoint, one for all records or one for each.
    subject : Subject
        Known already; default: fitted from this take.
    trial : Subject
        Of another trial of the same person: the fit of this take starts from its lengths.
    height : float [m]
        Stature, where it is known: the length of bones that nobody sees follows it.
    smooth : bool
        Fit all frames together in the end; without it each frame knows only of those before it.
    contacts : bool
        Hold the soles still where they rest on a level floor, when smoothing.
    shape_frames : int, how many frames bone lengths are found from.
    progress : called with (what, done, total).

    Raises
    ------
    TrackingError
        Nobody can be found, or no frame shows enough of the person.
    TrackingInterrupted
        Ctrl-C after at least one tracked frame.
    """
    if not keypoints:
        raise ObservationError("there are no keypoints to track", remedy="Name at least one [[keypoints]] in the take.")
    lengths, rates = {len(k) for k in keypoints}, {k.rate for k in keypoints}
    if len(lengths) > 1 or len(rates) > 1:
        told = ", ".join(f"{k.camera}: {len(k)} frames at {k.rate:g} Hz" for k in keypoints)
        raise ObservationError(f"keypoint streams differ ({told})", remedy="Set frames or rate in the take.")
    sigma = _accuracies(accuracy, len(keypoints))
    if len({k.camera for k in keypoints}) < 2:
        raise TrackingError(
            f"the keypoints are of one camera only, {keypoints[0].camera}", remedy="Tracking needs two cameras or more."
        )
    if height is not None and not 0.3 < height < 3.0:
        raise ObservationError(f"a height of {height:g} m", remedy="Give the person's height in metres.")
    channels = make_channels(body, rig, keypoints, choose_people(rig, keypoints), sigma)
    if subject is None:
        subject = fit_subject(body, channels, frames=shape_frames, height=height, trial=trial, progress=progress)
    channels = channels.with_points(subject.body)
    settings = settings or Settings()
    results = _run(Tracker(subject.body, channels, keypoints[0].rate, settings), channels, progress)
    frames = [r for r in results if r is not None]
    assert len(frames) == len(results)
    provenance = {}
    if smooth and len(frames) == len(channels.uv):
        frames, provenance["smoothing"] = smooth_results(
            subject.body, channels, frames, keypoints[0].rate, settings, contacts=contacts, up=up
        )
    frames, noise = with_lasting_errors(frames, subject, channels, keypoints[0].rate)
    provenance["length_std_m"] = subject.length_std
    provenance["detector noise"] = noise.as_told(channels.sources)
    motion = _motion(subject.body, channels, frames, keypoints[0], up, name, provenance)
    if len(motion) < len(channels.uv):
        raise TrackingInterrupted(motion, len(channels.uv))
    return motion


def _accuracies(accuracy: float | Sequence[float], count: int) -> list[float]:
    """One standard deviation [px] for each of the records."""
    values = np.asarray(accuracy, float).ravel()
    if len(values) not in (1, count) or not np.all((values > 0) & np.isfinite(values)):
        raise ObservationError(f"accuracies {values}", remedy=f"Give one positive number of pixels, or {count}.")
    return [float(v) for v in np.broadcast_to(values, count)]


def _run(tracker: Tracker, channels: Channels, progress: Progress | None) -> list[FrameResult | None]:
    """Results of all frames; of fewer where Ctrl-C came once the person had been found."""
    total = len(channels.uv)
    results: list[FrameResult | None] = []
    try:
        for f in range(total):
            results.append(tracker.update(channels.uv[f], channels.confidence[f]))
            if progress:
                progress("frames", f + 1, total)
    except KeyboardInterrupt:
        if not any(r is not None for r in results):
            raise
    first = next((f for f, r in enumerate(results) if r is not None), None)
    if first is None:
        raise TrackingError("the body was found in no frame", remedy="Check the calibration and the keypoints.")
    if first > 0:  # what came before the first good frame, backwards from it
        found = results[first]
        assert found is not None
        tracker.start_at(found.state)
        for f in range(first - 1, -1, -1):
            results[f] = tracker.update(channels.uv[f], channels.confidence[f])
    return results


def _motion(
    body: Body, channels: Channels, frames: list[FrameResult], record: Keypoints, up: str, name: str,
    provenance: dict[str, Any],
) -> Motion:  # fmt: skip
    factor, uv = np.stack([r.factor for r in frames]), np.stack([r.uv for r in frames])
    fitted, swapped = np.stack([r.fitted for r in frames]), np.stack([r.swapped for r in frames])
    residuals = {}
    for q, label in enumerate(channels.sources):
        mine = channels.source == q
        columns = channels.column[mine]
        residuals[label] = Residuals(
            names=tuple(channels.points.names[c] for c in columns),
            segments=channels.points.segments[columns],
            values=uv[:, mine] - fitted[:, mine],
            weights=factor[:, mine],
            unit="px",
            measured=uv[:, mine],
            swapped=np.any(swapped[:, mine], axis=1),
        )
    return Motion(
        body=body,
        rate=record.rate,
        times=record.times[: len(frames)],
        Ts_world_root=np.stack([r.state.T_world_root for r in frames]),
        angles=np.stack([r.state.angles for r in frames]),
        dof_std=np.stack([r.dof_std for r in frames]),
        joint_std=np.stack([r.joint_std for r in frames]),
        quality=np.array([r.quality for r in frames]),
        segment_quality=np.stack([r.segment_quality for r in frames]),
        residuals=residuals,
        up=up,
        name=name,
        provenance=provenance,
    )
