"""Where cameras stand, from the people in view alone: their own keypoints are the calibration object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked, renamed
from kinefit.bodies import Body, PointSet
from kinefit.bodies.rigid_pairs import rigid_pairs
from kinefit.calibration.people.first_rig import first_rig
from kinefit.calibration.people.floor import centre_of_mass, settled
from kinefit.calibration.refine.bundle import bundle_adjust
from kinefit.calibration.refine.gauge import resized
from kinefit.calibration.refine.refine import Length, check_input, length_of, prior_sigma, refine_from
from kinefit.calibration.refine.result import Refinement
from kinefit.calibration.refine.sightings import PersonSighting, PersonTrial, Progress
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.multiview.association import person_records
from kinefit.observations import KEYPOINT_SIGMA, Keypoints
from kinefit.sensors.channels import Channels, make_channels
from kinefit.solvers.bundle.cameras import CameraPrior, PointPixels

_SURE = 0.3  # confidence of a keypoint that takes part in the start
_MOST = 2500  # points in space of the start
_ANYWHERE = 20.0, 3.0  # [m], [rad] no prior to speak of
_AGREE = 5.0  # standard deviations within which the cameras' rays meet, before they are adjusted


@renamed(accuracy="sigma")
@checked
def calibrate_people(
    cameras: Sequence[Camera],
    keypoints: Sequence[Keypoints],
    body: Body,
    *,
    height: float | None = None,
    known_length: Length | None = None,
    focal: bool = False,
    time_offsets: bool = False,
    up: str = "z",
    sigma: float = KEYPOINT_SIGMA,
    progress: Progress | None = None,
) -> Refinement:
    """Poses of cameras whose intrinsics are known, from a person who moves in front of them.

    Essential matrices choose the pair to start from; the other cameras are laid on its points (see `first_rig`); free
    points, then the body with its constant bone lengths, are adjusted together with all cameras.

    Parameters
    ----------
    cameras : their names, sizes, matrices and distortions; poses are not used.
    keypoints : records of the same number of frames and the same rate.
    body : Body, generic.
    height : float [m] stature of the person: sets the scale; default: the generic body's bones.
    known_length : (point, point, [m]) of the body: sets the scale instead.
    focal, time_offsets : bool, estimate focal lengths, and time offsets, too.
    up : str, vertical axis that the world shall have.

    Raises
    ------
    CalibrationError
        Too few common keypoints, a camera that fits no other, cameras too close together, too little motion.
    ObservationError
        Streams that differ; a height or length that cannot be.
    """
    step = progress or (lambda *_: None)
    given = Rig(tuple(camera.with_pose(np.eye(4)) for camera in cameras))
    check_input(given, keypoints, height, known_length)
    step("first cameras", 0, 2)
    alone = [steady_person(record) for record in keypoints]
    in_step = person_records(alone, [np.zeros(len(k), int) for k in alone])
    channels = make_channels(body, given, in_step, [sigma] * len(alone))
    uv = common_pixels(channels)
    rig = first_rig(given, uv.reshape(-1, len(given), 2), sigma)
    step("first cameras", 1, 2)
    rig, x = _adjusted(rig, uv, sigma, focal=focal)
    factor = _whole_scale(body, channels.points, x, height)
    rig = settled(resized(rig, factor), factor * x, _above_soles(body, channels.points), up=up)
    step("first cameras", 2, 2)
    prior_std = prior_sigma(len(rig), focal=focal, distortion=False, time_offsets=time_offsets)
    prior_std[:, :3], prior_std[:, 3:6] = _ANYWHERE
    prior = CameraPrior(Rig(tuple(replace(a, matrix=b.matrix) for a, b in zip(rig, given, strict=True))), prior_std)

    def stand(rig: Rig, seen: PersonSighting) -> tuple[Rig, str]:
        return _on_the_floor(rig, seen, body, height, known_length, up)

    return refine_from(rig, PersonTrial(keypoints, body, up, sigma), prior, stand, progress=progress, from_scratch=True)


def steady_person(record: Keypoints) -> Keypoints:
    """The same person of one camera in all frames: the one seen best, and whoever is nearest to where that one was."""
    frames, people = record.points.shape[:2]
    seen = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    sure = np.where(seen, record.confidence, 0.0).sum(axis=-1)
    x = np.where(seen[..., None], record.points, np.nan)
    with np.errstate(all="ignore"):
        count = np.maximum(seen.sum(axis=2), 1)[..., None]
        centre = np.nansum(x, axis=2) / count
        size = np.sqrt(np.nansum((x - centre[:, :, None]) ** 2, axis=(2, 3)) / count[..., 0])
    size = np.where(sure > 0, size, 0.0)
    best = int(np.argmax((sure * size).max(axis=1))) if people else 0
    chosen = np.full(frames, -1)
    for order in (range(best, frames), range(best, -1, -1)):
        last: NDArray | None = None
        for f in order:
            near = 1.0 if last is None else np.exp(-np.linalg.norm(centre[f] - last, axis=1) / np.maximum(size[f], 1.0))
            score = sure[f] * size[f] * near if people else np.zeros(1)
            if score.max() > 0:
                chosen[f] = int(np.argmax(score))
                last = centre[f, chosen[f]]
    if not (chosen >= 0).any():
        raise CalibrationError(
            "nobody is seen in any frame", file=record.source or None, place=f"camera {record.camera}",
            remedy="Leave this camera out, or find the keypoints anew.",
        )
    return record.of_one(chosen)


def common_pixels(channels: Channels) -> NDArray:
    """(F, K, C, 2) [px] of every point in every camera, NaN where unseen or unsure."""
    out = np.full((len(channels.uv), len(channels.points), len(channels.rig), 2), np.nan)
    sure = np.where((channels.confidence > _SURE)[..., None], channels.uv, np.nan)
    out[:, channels.column, channels.camera] = sure
    return out


def _adjusted(rig: Rig, uv: NDArray, sigma: float, *, focal: bool) -> tuple[Rig, NDArray]:
    """The rig adjusted with free points, and the points (F, K, 3) in its units."""
    flat = uv.reshape(-1, len(rig), 2)
    x, agree, _ = triangulate_robust(rig, flat, max_residual_px=_AGREE * sigma)
    good = np.flatnonzero(agree.sum(axis=1) >= 2)
    good = good[np.unique(np.linspace(0, len(good) - 1, min(_MOST, len(good))).astype(int))]
    point, camera = np.nonzero(np.isfinite(flat[good]).all(axis=-1))
    pixels = PointPixels(camera, point, flat[good][point, camera], np.full(len(point), sigma**-2))
    prior_std = prior_sigma(len(rig), focal=focal, distortion=False, time_offsets=False)
    size = np.linalg.norm(np.ptp([c.centre_world for c in rig], axis=0))
    prior_std[:, :3], prior_std[:, 3:6] = 10.0 * size, _ANYWHERE[1]
    rig = bundle_adjust(rig, pixels, x[good], CameraPrior(rig, prior_std)).rig
    x = triangulate_robust(rig, flat, max_residual_px=_AGREE * sigma)[0]
    return rig, x.reshape(*uv.shape[:2], 3)


def _whole_scale(body: Body, points: PointSet, x: NDArray, height: float | None) -> float:
    """Factor that gives the person the generic body's bones, or bones in proportion to a height [m]."""
    ratios = []
    for i, j, _, length in rigid_pairs(body, points):
        distance = np.linalg.norm(x[:, i] - x[:, j], axis=1)
        if np.isfinite(distance).sum() >= 3:
            ratios.append(float(np.nanmedian(distance)) / length)
    if not ratios:
        raise CalibrationError(
            "no bone of the person can be measured", remedy="Record a person who is seen whole in two cameras at once."
        )
    whole = height / body.stature if height and body.stature else 1.0
    return whole / float(np.median(ratios))


def _above_soles(body: Body, points: PointSet) -> NDArray:
    """(K,) [m] height of points above the soles of the body at rest."""
    lowest = min(body.points_rest(body.landmarks)[:, 1].min(), body.points_rest(points)[:, 1].min())
    return body.points_rest(points)[:, 1] - lowest


def _on_the_floor(
    rig: Rig, seen: PersonSighting, generic: Body, height: float | None, known_length: Length | None, up: str
) -> tuple[Rig, str]:
    """The rig with floor, origin and scale by the rule, and the rule."""
    body = seen.motion.body
    factor = sum(generic.segment_lengths().values()) / sum(body.segment_lengths().values())
    rule = "the scale is that of a person of mean proportions (a few per cent unsure: give a height or a length)"
    if known_length is not None:
        a, b, metres = known_length
        factor, rule = metres / length_of(seen, a, b), f"{a} to {b} is {metres:g} m long"
    elif height is not None and body.stature > 0:
        factor, rule = height / body.stature, f"the person is {height:g} m tall"
    x = factor * seen.motion.positions()
    rig = settled(
        resized(rig, factor), x, factor * _above_soles(body, body.landmarks),
        balance=factor * centre_of_mass(seen.motion), up=up,
    )  # fmt: skip
    return rig, f"The floor is at height zero, {up} is up, the origin lies below the person's mean place; {rule}."
