"""From a recording of any sensors to a motion: the main job."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.frame.results import FrameResult
from kinefit.motion import Motion, Residuals
from kinefit.sensors.base import Leftover, Matched, leftovers_at
from kinefit.sensors.keypoints import KeypointMatched
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.linearised import OtherSensors
from kinefit.smoothing.sensor_noise import other_noise
from kinefit.smoothing.smoother import pixels_of_track, smooth_results
from kinefit.smoothing.uncertainty import with_lasting_errors
from kinefit.subject.keypoints import Progress, Subject
from kinefit.tracking.agreement import contradictions
from kinefit.tracking.interrupted import TrackingInterrupted
from kinefit.tracking.recording import Recording
from kinefit.tracking.run import Tracked, run
from kinefit.tracking.sizing import fitted_to_person


def track(
    recording: Recording, body: Body, *, subject: Subject | None = None, trial: Subject | None = None,
    height: float | None = None, size: bool = True, settings: TrackSettings | None = None, smooth: bool = True,
    contacts: bool = False, shape_frames: int | None = None, progress: Progress | None = None,
) -> Motion:  # fmt: skip
    """Motion of one person from whatever sensors saw, with no pose given.

    The body is fitted to the person, every frame is fitted to all that was measured then, with outliers and exchanged
    sides set right, lost limbs sought; in the end all frames are fitted together with a motion prior whose process
    noise the take itself tells.

    Parameters
    ----------
    recording : Recording
    body : Body, generic.
    subject : Subject
        Known already; default: fitted from this recording.
    trial : Subject
        Of another trial of the same person, from keypoints: the fit of this one starts from its lengths.
    height : float [m]
        Stature, where it is known: the length of bones that nobody sees follows it.
    size : whether the body is fitted to the person
    settings : TrackSettings
    smooth : bool
        Fit all frames together in the end; without it each frame knows only of those before it.
    contacts : bool
        Hold the soles still where they rest on a level floor, when smoothing.
    shape_frames : int, how many frames bone lengths are found from by keypoints of several cameras; default 25.
    progress : called with (what, done, total).

    Raises
    ------
    ObservationError
        What would be ignored: contacts without smoothing, a height where the body is not sized, a trial or shape_frames
        without keypoints of two cameras. A height that cannot be.
    TrackingError
        Nobody can be found, or no frame shows enough of the person.
    TrackingInterrupted
        Ctrl-C after at least one tracked frame.
    """
    if contacts and not smooth:
        remedy = "Leave smooth as it is: contacts need the whole take."
        raise ObservationError("contacts without smoothing", remedy=remedy)
    if height is not None and not 0.3 < height < 3.0:
        raise ObservationError(f"a height of {height:g} m", remedy="Give the person's height in metres.")
    settings = settings or TrackSettings()
    person = fitted_to_person(
        recording, body, settings, subject=subject, trial=trial, height=height, size=size, frames=shape_frames,
        progress=progress,
    )  # fmt: skip
    tracked = run(
        person.recording, person.subject.body, person.channels, settings, start=person.start, values=person.values,
        progress=progress,
    )  # fmt: skip
    motion = _motion(person.recording, person, tracked, settings, smooth and tracked.complete, contacts)
    if not tracked.complete:
        raise TrackingInterrupted(motion, len(recording))
    return motion


def _motion(
    recording: Recording, person: Any, tracked: Tracked, settings: TrackSettings, smooth: bool, contacts: bool
) -> Motion:
    """The motion of what was tracked, smoothed where that is asked for, with lasting errors in its deviations."""
    tracker, subject, rate = tracked.tracker, person.subject, recording.rate
    body, results, leftovers = subject.body, tracked.results, tracked.leftovers
    times = recording.times[tracked.steps]
    channels = person.channels.part(tracked.steps)
    provenance: dict[str, Any] = dict(person.told)
    others = None
    if any(tracked.measurements):
        others = OtherSensors(
            times, tuple(tracked.measurements), tracker.scene_of, tracker.apart, settings,
            dict.fromkeys({m.sensor for several in tracked.measurements for m in several}, 1.0),
        )  # fmt: skip
    matched: tuple[tuple[Matched, ...], ...] | None = None
    if smooth:
        done = smooth_results(
            body, channels, results, rate, settings, tracker.scene_of, others=others, contacts=contacts,
            up=recording.up,
        )  # fmt: skip
        results, take, weight = done.results, done.take, done.weight
        provenance["smoothing"] = done.provenance
        others, matched = take.others, None if take.linear is None else take.linear.matched
        leftovers = []
        for f, r in enumerate(results):
            scene = tracker.scene_of(r.state, r.time) if others is None else others.scene(f, take.roots, take.angles)
            leftovers.append([rest for m in r.matched for rest in leftovers_at(m, scene)])
    else:
        take = pixels_of_track(body, channels, results, rate, settings)
        factor = take.factors(channels.sigma, take.fitted(take.roots, take.angles))
        weight = take.confidence / np.square(channels.sigma) * factor
        if others is not None:
            matched = others.linearised(body, take.roots, take.angles).matched
    scenes = [
        tracker.scene_of(r.state, r.time) if others is None else others.scene(f, take.roots, take.angles)
        for f, r in enumerate(results)
    ]
    seen = [[m for m in r.matched if isinstance(m, KeypointMatched)] for r in results]
    if matched is not None:
        seen = [[*mine, *more] for mine, more in zip(seen, matched)]
    provenance["contradictions"] = contradictions(scenes, seen)
    noise_of_others = None
    if others is not None and matched is not None:
        noise_of_others = other_noise(body, others, matched, take.roots, take.angles)
        provenance["sensor noise"] = noise_of_others.as_told()
    results, noise = with_lasting_errors(results, subject, take, weight, rate, noise_of_others)
    if channels.sources:
        provenance["detector noise"] = noise.as_told(channels.sources)
    provenance["length_std_m"] = subject.length_std
    provenance["estimate"] = "smoothed" if smooth else "filtered"
    provenance["frames"] = {"dropped": tracker.dropped, "late": tracker.late}
    return Motion(
        body=body,
        rate=rate,
        times=times,
        Ts_world_root=np.stack([r.state.T_world_root for r in results]),
        angles=np.stack([r.state.angles for r in results]),
        dof_std=np.stack([r.dof_std for r in results]),
        joint_std=np.stack([r.joint_std for r in results]),
        quality=np.array([r.quality for r in results]),
        segment_quality=np.stack([r.segment_quality for r in results]),
        residuals=residuals_of(leftovers, results),
        up=recording.up,
        name=recording.name,
        provenance=provenance,
    )


def residuals_of(leftovers: Sequence[Sequence[Leftover]], results: Sequence[FrameResult]) -> dict[str, Residuals]:
    """What every sensor left over in all frames."""
    F = len(results)
    frames: dict[str, dict[int, Leftover]] = {}
    for f, several in enumerate(leftovers):
        for rest in several:
            frames.setdefault(rest.label, {})[f] = rest
    out = {}
    for label, of in frames.items():
        names: dict[str, int] = {}
        for rest in of.values():
            for name, segment in zip(rest.names, rest.segments):
                names.setdefault(name, int(segment))
        place = {name: k for k, name in enumerate(names)}
        one = next(iter(of.values()))
        shape = F, len(names), one.values.shape[1]
        values, measured = np.full(shape, np.nan), np.full(shape, np.nan)
        weights, swapped = np.zeros(shape[:2]), np.zeros(F, bool)
        surface = one.count is not None
        rms, count = np.full(shape[:2], np.nan), np.zeros(shape[:2])
        for f, rest in of.items():
            columns = [place[name] for name in rest.names]
            values[f, columns], weights[f, columns] = rest.values, rest.weights
            measured[f, columns], swapped[f] = rest.measured, rest.swapped
            if rest.rms is not None and rest.count is not None:
                rms[f, columns], count[f, columns] = rest.rms, rest.count
        out[label] = Residuals(
            names=tuple(names), segments=np.array(list(names.values()), np.int64), values=values, weights=weights,
            unit=one.unit, measured=measured, swapped=swapped, rms=rms if surface else None,
            count=count if surface else None,
        )  # fmt: skip
    return out
