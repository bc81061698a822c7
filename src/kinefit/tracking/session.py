"""What a live session keeps of each frame, so that it becomes a motion like any other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body
from kinefit.errors import ObservationError, choices
from kinefit.frame.results import FrameResult
from kinefit.geometry.camera import Rig
from kinefit.motion import UP_AXES
from kinefit.observations import Keypoints
from kinefit.observations.arrays import numbers
from kinefit.sensors.base import Leftover, Measurement, leftovers_at
from kinefit.sensors.channels import Channels, make_channels
from kinefit.sensors.points.keypoints import KeypointMatched, KeypointMeasurement, Layout
from kinefit.sensors.scene import Scene
from kinefit.smoothing.linearised import ApartRows, SceneOf
from kinefit.smoothing.spool import Spool
from kinefit.tracking.motions import TrackedFrames

_Key = tuple[str, str, int]  # camera, keypoint set, and which of a layout's records of these


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """What is kept of a tracked frame: no whole images.

    Parameters
    ----------
    result : FrameResult, with the matches of keypoints alone
    measurements : what all sensors but the keypoints measured
    leftovers : what the fit leaves over of every sensor
    """

    result: FrameResult
    measurements: tuple[Measurement, ...]
    leftovers: tuple[Leftover, ...]

    @classmethod
    def of(cls, result: FrameResult, scene: Scene) -> KeptFrame:
        """Of a result as a tracker gives it; the scene is at its state, with its measurements and velocity."""
        pixels = tuple(m for m in result.matched if isinstance(m, KeypointMatched))
        return cls(
            replace(result, matched=pixels, measurements=()),
            tuple(m.compact() for m in result.measurements if not isinstance(m, KeypointMeasurement)),
            tuple(rest for m in result.matched for rest in leftovers_at(m, scene)),
        )  # fmt: skip

    def joined(self, later: KeptFrame) -> KeptFrame:
        """With what other sensors saw before the next frame is due."""
        return KeptFrame(
            replace(later.result, matched=self.result.matched + later.result.matched),
            self.measurements + later.measurements, self.leftovers + later.leftovers,
        )  # fmt: skip


class Session:
    """Frames of a live session, one a step of its rate: steps that were dropped are kept as frames that see nothing.

    Parameters
    ----------
    rate : float [Hz]
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.clear()

    def __len__(self) -> int:
        return len(self._results)

    def clear(self) -> None:
        """Begin anew: another body, or another clock."""
        self._results: list[FrameResult] = []
        self._measurements, self._leftovers = Spool[tuple[Measurement, ...]](), Spool[tuple[Leftover, ...]]()

    def _append(self, one: KeptFrame) -> None:
        self._results.append(one.result)
        self._measurements.append(one.measurements)
        self._leftovers.append(one.leftovers)

    def add(self, result: FrameResult, scene: Scene) -> None:
        """Keep a result; a time before that of the last frame begins anew."""
        new = KeptFrame.of(result, scene)
        if not self._results:
            self._append(new)
            return
        last = self._results[-1]
        ahead = round((result.time - last.time) * self.rate)
        if result.time < last.time:
            self.clear()
            self._append(new)
        elif ahead == 0:
            new = replace(new, result=replace(new.result, time=last.time))
            both = KeptFrame(last, self._measurements[-1], self._leftovers[-1]).joined(new)
            self._results[-1], self._measurements[-1], self._leftovers[-1] = (
                both.result, both.measurements, both.leftovers
            )  # fmt: skip
        else:
            gap = result.time - last.time
            for k in range(1, ahead):
                self._append(KeptFrame(unseen(last, last.time + gap * k / ahead), (), ()))
            self._append(new)

    def frames(self, body: Body, rig: Rig, scene_of: SceneOf, apart: ApartRows) -> TrackedFrames:
        """All of them, with the keypoints of whatever cameras as one list of channels."""
        results = self._results
        channels, matches = one_layout(body, rig, results, self.rate)
        return TrackedFrames(
            channels, [replace(r, matched=m) for r, m in zip(results, matches)], self._measurements[:],
            self._leftovers[:], np.array([r.time for r in results]), self.rate, scene_of, apart,
        )  # fmt: skip


def unseen(last: FrameResult, time: float) -> FrameResult:
    """A frame that nobody saw, after a result."""
    segments = np.zeros(len(last.hidden), bool)
    return FrameResult(
        time, last.state, np.full_like(last.dof_std, np.inf), np.full_like(last.joint_std, np.inf),
        np.zeros_like(last.segment_quality), segments, ~segments, 0.0, 0,
    )  # fmt: skip


def one_layout(
    body: Body, rig: Rig, results: Sequence[FrameResult], rate: float
) -> tuple[Channels, list[tuple[KeypointMatched, ...]]]:
    """Keypoints of F results, of whatever cameras took part in each, as channels of all of them, and their matches.

    Parameters
    ----------
    results : F frames
    rate : float [Hz]

    Returns
    -------
    channels of the F frames, and of each frame its keypoints matched in these channels, or nothing
    """
    matches = [[m for m in r.matched if isinstance(m, KeypointMatched)] for r in results]
    names: dict[_Key, dict[str, int]] = {}
    sigma: dict[_Key, float] = {}
    keys: dict[int, list[tuple[_Key, str]]] = {}
    for m in (m for several in matches for m in several):
        layout = m.measurement.layout
        if id(layout) not in keys:
            keys[id(layout)] = _keys(layout.channels)
            for (key, name), s in zip(keys[id(layout)], layout.channels.sigma):
                names.setdefault(key, {}).setdefault(name, len(names[key]))
                sigma.setdefault(key, float(s))
    if not names:
        return Channels.none(rig, len(results)), [()] * len(results)
    values = {k: np.full((len(results), 1, len(n), 2), np.nan) for k, n in names.items()}
    trust = {k: np.zeros((len(results), 1, len(n))) for k, n in names.items()}
    for f, several in enumerate(matches):
        for m in several:
            of = m.measurement
            for (key, name), uv, confidence in zip(keys[id(of.layout)], of.uv, of.confidence):
                if confidence > 0.0:
                    values[key][f, 0, names[key][name]], trust[key][f, 0, names[key][name]] = uv, confidence
    records = [Keypoints(k[0], k[1], tuple(n), rate, values[k], trust[k]) for k, n in names.items()]
    people = [np.zeros(len(results), np.int64)] * len(records)
    channels = make_channels(body, rig, records, people, list(sigma.values()))
    layout, order = Layout(channels, body), list(names)
    place = {(order[q], channels.points.names[c]): k for k, (q, c) in enumerate(zip(channels.source, channels.column))}
    columns = {one: np.array([place[k] for k in own], np.int64) for one, own in keys.items()}
    out: list[tuple[KeypointMatched, ...]] = []
    for f, several in enumerate(matches):
        out.append(() if not several else (_together(several, columns, layout, f, results[f].time),))
    return channels, out


def _together(
    several: Sequence[KeypointMatched], columns: dict[int, NDArray], layout: Layout, f: int, time: float
) -> KeypointMatched:
    """Matches of one time in another layout."""
    channels = layout.channels
    measurement = KeypointMeasurement(several[0].measurement.of, layout, channels.uv[f], channels.confidence[f], time)
    swapped, hidden = np.zeros(len(channels.column), bool), []
    for m in several:
        column = columns[id(m.measurement.layout)]
        swapped[column] = m.swapped
        hidden += [replace(h, index=column[h.index], far=column[h.far]) for h in m.hidden]
    order = np.where(swapped, channels.partner, np.arange(len(swapped)))
    return KeypointMatched(
        measurement, np.ascontiguousarray(measurement.uv[order]), np.ascontiguousarray(measurement.weight[order]),
        swapped, several[0].loss, tuple(hidden),
    )  # fmt: skip


def _keys(channels: Channels) -> list[tuple[_Key, str]]:
    """Of each channel its camera, its keypoint set and its record among them, and its point's name."""
    count: dict[tuple[str, str], int] = {}
    of: dict[int, _Key] = {}
    out = []
    for q, camera, c in zip(channels.source, channels.camera, channels.column):
        if q not in of:
            name = next(n for n, span in channels.sets.items() if span.start <= c < span.stop)
            pair = channels.rig.cameras[camera].name, name
            of[q] = (*pair, count.get(pair, 0))
            count[pair] = count.get(pair, 0) + 1
        out.append((of[q], channels.points.names[c]))
    return out


def axis_of(up: NDArray) -> str:
    """Name of the axis of the world that is nearest to a direction (3,)."""
    return max(UP_AXES, key=lambda name: float(np.dot(up, UP_AXES[name])))


def up_vector(up: str | ArrayLike) -> NDArray:
    """(3,) upwards in the world, of the name of an axis ("z", "-y", ...) or of three numbers.

    Raises
    ------
    ObservationError
        No such axis; not three numbers.
    """
    if isinstance(up, str) and up not in UP_AXES:
        raise ObservationError(choices("vertical axis", up, UP_AXES))
    vector = numbers(UP_AXES[up] if isinstance(up, str) else up, float, "up")
    if vector.shape != (3,):
        raise ObservationError(f"up has shape {vector.shape}", remedy="Give three numbers, such as (0, 0, 1).")
    return vector
