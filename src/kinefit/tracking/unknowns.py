"""Which parameters of a person and of sensors a recording can tell, and where the fit of them begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.sensors.base import Measurement
from kinefit.subject.keypoints import Subject
from kinefit.subject.parameters import KnownLengths, Parameters, PointOffsets, SegmentScales, World
from kinefit.subject.sensor_parameters import OwnUnknowns
from kinefit.subject.surfaces import shape_of
from kinefit.tracking.recording import Recording

_SEAT = 0.01  # [m] how far a marker of the body's own set sits from its place on a person


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What a subject fit of all sensors is to find.

    Parameters
    ----------
    world : that the parameters apply to
    parameters : kinds of them
    start : (p,) values to start from
    """

    world: World
    parameters: tuple[Parameters, ...]
    start: NDArray


def unknowns_of(
    recording: Recording, generic: Body, subject: Subject, measurements: Sequence[Measurement], *,
    size: bool = True, height: float | None = None, trial: Subject | None = None,
) -> Unknowns:  # fmt: skip
    """Parameters that the sensors which took part can tell; without `size` those of the sensors themselves alone.

    Lengths and places of keypoints and markers have the generic body's prior: the fit from one kind of sensors that
    came first says where to begin, and is not counted again. After depth alone they start at the body in its size.

    Parameters
    ----------
    generic : the body before any fit
    subject : what the first fit found
    measurements : of the frames that are fitted, of all sensors but the keypoints
    height, trial : as of `track`
    """
    found: list[tuple[Parameters, NDArray]] = []
    body = subject.body
    if size:
        surfaces = any(not m.settled for m in measurements)
        sets = _marker_sets(recording)
        keypoints = {} if subject.shape is None else _keypoint_offsets(generic, subject)
        if keypoints or sets:
            body = generic
            lengths = SegmentScales(generic, height / generic.stature if height and generic.stature else None)
            if trial is not None and trial.covariance is not None:
                count = len(trial.scales)
                lengths = KnownLengths(
                    generic, scales=trial.scales, covariance=trial.covariance[:count, :count]
                )
            found.append((lengths, np.log(subject.scales)))
        elif surfaces or recording.markers:
            found.append((SegmentScales(body), np.zeros(len(body.scale_groups))))
        found += list(keypoints.values())
        if surfaces:
            found += [(shape, shape.mean) for shape in shape_of(body)]
        scaled = generic.scaled(subject.scales)
        for name, std in sets.items():
            offsets = PointOffsets(generic, name, std)
            shifts = subject.body.markers(name).points - scaled.markers(name).points
            found.append((offsets, offsets.values_of(shifts)))
    unknown = OwnUnknowns.of(recording.sensors)
    if unknown.names:
        found.append((unknown, unknown.mean))
    start = np.concatenate([np.zeros(0), *(values for _, values in found)])
    return Unknowns(World(body, recording.rig), tuple(p for p, _ in found), start)


def _marker_sets(recording: Recording) -> dict[str, NDArray | float]:
    """{marker set: how far [m] its markers may sit elsewhere}."""
    return {name: _SEAT if std is None else std for name, std in recording.marker_sets if name}


def _keypoint_offsets(generic: Body, subject: Subject) -> dict[str, tuple[Parameters, NDArray]]:
    """Of every keypoint set its offsets, as far as the keypoints' own fit found that they may be, and where it did."""
    assert subject.shape is not None
    known, groups = subject.shape, len(subject.scales)
    std = float(1.0 / np.sqrt(np.min(np.diag(known.prior)[groups:])))
    scaled, out = generic.scaled(subject.scales), dict[str, tuple[Parameters, NDArray]]()
    for name in subject.sets:
        offsets = PointOffsets(generic, name, std)
        out[name] = offsets, offsets.values_of(subject.body.keypoints(name).points - scaled.keypoints(name).points)
    return out
