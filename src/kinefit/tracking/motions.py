"""From tracked frames to a motion: smoothed where that is asked for, with lasting errors in its deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.frame.results import FrameResult
from kinefit.motion import Motion, Residuals
from kinefit.sensors.base import Leftover, Matched, Measurement, leftovers_at
from kinefit.sensors.channels import Channels
from kinefit.sensors.keypoints import KeypointMatched
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.fixed_lag import FixedLag
from kinefit.smoothing.known_noise import KnownNoise
from kinefit.smoothing.lag_frame import Followed
from kinefit.smoothing.linearised import ApartRows, OtherSensors, SceneOf
from kinefit.smoothing.process_noise import SmoothTake
from kinefit.smoothing.sensor_noise import other_noise
from kinefit.smoothing.smoother import pixels_of_track, smooth_results
from kinefit.smoothing.uncertainty import with_lasting_errors
from kinefit.smoothing.unwrap import unwrap
from kinefit.subject.keypoints import Subject
from kinefit.tracking.agreement import contradictions


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """F consecutive frames as a tracker left them.

    Parameters
    ----------
    channels : keypoints of the F frames, of no points where there are none
    results : F frames, with the matches of keypoints alone
    measurements : of each of them what all sensors but the keypoints measured, without whole images
    leftovers : of each of them, what the fit leaves over of every sensor
    times : (F,) [s]
    rate : float [Hz]
    scene_of, apart : those of the tracker
    """

    channels: Channels
    results: Sequence[FrameResult]
    measurements: Sequence[tuple[Measurement, ...]]
    leftovers: Sequence[Sequence[Leftover]]
    times: NDArray
    rate: float
    scene_of: SceneOf
    apart: ApartRows


def motion_of(
    frames: TrackedFrames, subject: Subject, settings: TrackSettings, *, smooth: bool = True, contacts: bool = False,
    lag: float | None = None, noise: KnownNoise | None = None, up: str = "z", name: str = "motion",
    told: Mapping[str, Any] | None = None,
) -> Motion:  # fmt: skip
    """The motion of what was tracked.

    Parameters
    ----------
    frames : TrackedFrames
    subject : Subject, with the body; its lengths are taken for exact where it does not tell how sure they are.
    settings : TrackSettings
    smooth : fit all frames together with a motion prior
    contacts : hold the soles still where they rest on a level floor, when smoothing
    lag : [s], instead of smoothing: each frame knows of those before it, and of later ones so far ahead alone
    noise : that is known beforehand, for a lag
    up, name : of the motion
    told : what else there is to tell, for `Motion.provenance`
    """
    body, rate, results, leftovers = subject.body, frames.rate, list(frames.results), frames.leftovers
    channels = frames.channels
    provenance: dict[str, Any] = dict(told or {})
    others = None
    if any(frames.measurements):
        others = OtherSensors(
            frames.times, tuple(frames.measurements), frames.scene_of, frames.apart, settings,
            dict.fromkeys({m.sensor for several in frames.measurements for m in several}, 1.0),
            2 * np.count_nonzero(channels.weight, axis=1),
        )  # fmt: skip
    matched: tuple[tuple[Matched, ...], ...] | None = None
    if smooth:
        done = smooth_results(
            body, channels, results, rate, settings, frames.scene_of, others=others, contacts=contacts, up=up
        )
        results, take, weight = done.results, done.take, done.weight
        provenance["smoothing"] = done.provenance
        others, matched = take.others, None if take.linear is None else take.linear.matched
        leftovers = _leftovers(results, frames.scene_of, others, take)
    else:
        if lag is not None:
            results, provenance["fixed lag"] = _behind(frames, body, settings, lag, noise)
        take = pixels_of_track(body, channels, results, rate, settings)
        if lag is not None:
            leftovers = _leftovers(results, frames.scene_of, others, take)
        factor = take.factors(channels.sigma, take.fitted(take.roots, take.angles))
        weight = take.confidence / np.square(channels.sigma) * factor
        if others is not None:
            kept = tuple(tuple(m for m in r.matched if not isinstance(m, KeypointMatched)) for r in results)
            matched = others.linearised(body, take.roots, take.angles).matched if lag is None else kept
    scenes = [
        frames.scene_of(r.state, r.time) if others is None else others.scene(f, take.roots, take.angles)
        for f, r in enumerate(results)
    ]
    saw: list[list[Matched]] = [[m for m in r.matched if isinstance(m, KeypointMatched)] for r in results]
    if matched is not None:
        saw = [[*mine, *more] for mine, more in zip(saw, matched)]
    provenance["contradictions"] = contradictions(scenes, saw)
    noise_of_others = None
    if others is not None and matched is not None:
        noise_of_others = other_noise(body, others, matched, take.roots, take.angles)
        provenance["sensor noise"] = noise_of_others.as_told()
    results, detectors = with_lasting_errors(results, subject, take, weight, rate, noise_of_others)
    if channels.sources:
        provenance["detector noise"] = detectors.as_told(channels.sources)
    provenance["length_std_m"] = subject.length_std
    provenance["estimate"] = "smoothed" if smooth else "filtered" if lag is None else "fixed lag"
    return Motion(
        body=body,
        rate=rate,
        times=frames.times,
        Ts_world_root=np.stack([r.state.T_world_root for r in results]),
        angles=np.stack([r.state.angles for r in results]),
        dof_std=np.stack([r.dof_std for r in results]),
        joint_std=np.stack([r.joint_std for r in results]),
        quality=np.array([r.quality for r in results]),
        segment_quality=np.stack([r.segment_quality for r in results]),
        residuals=residuals_of(leftovers, results),
        up=up,
        name=name,
        provenance=provenance,
    )


def _behind(
    frames: TrackedFrames, body: Body, settings: TrackSettings, lag: float, noise: KnownNoise | None
) -> tuple[list[FrameResult], dict[str, Any]]:
    """All frames as a live session has them a lag [s] behind, with angles that go on; and what there is to tell."""
    behind = FixedLag(Followed(body, frames.rate, settings, frames.scene_of, frames.apart), lag, noise=noise)
    out: list[FrameResult] = []
    for result, measurements in zip(frames.results, frames.measurements):
        out += behind.add(result, measurements, ahead=1)
    out += behind.finish()
    angles = unwrap(body.tree, np.stack([r.state.angles for r in out]))
    out = [replace(r, state=BodyState(r.state.T_world_root, q)) for r, q in zip(out, angles)]
    return out, {"seconds": round(behind.seconds, 4), **behind.noise.as_told(body)}


def _leftovers(
    results: Sequence[FrameResult], scene_of: SceneOf, others: OtherSensors | None, take: SmoothTake
) -> list[list[Leftover]]:
    """What every sensor leaves over of results, with the body where it is when each measured."""
    out = []
    for f, r in enumerate(results):
        scene = scene_of(r.state, r.time) if others is None else others.scene(f, take.roots, take.angles)
        out.append([rest for m in r.matched for rest in leftovers_at(m, scene)])
    return out


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
