"""Where a fit found the cameras, beside where their calibration has them; sensors that contradict each other.

Depth cameras that do not stand where the videos see the person: where they belong, or that they are of no use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.bodies.motion import Residuals
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.subject.subject import OUTLIER_SIGMAS, SensorFrames, Subject, SubjectFit, moved_rig
from kinefit.fitting.tracking.recording import Recording, spread
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, by_record
from kinefit.sensors.alignment import MISFIT_SIGMAS, POSE_SIGMAS, SensorAlignment
from kinefit.sensors.base import Matched, Measurement, rows_at
from kinefit.sensors.displaced import Displaced, displacement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import CameraErrors, TrackSettings
from kinefit.sensors.surfaces import point_cloud
from kinefit.solving.rows import Rows

CAMERAS = "cameras"
"""Key of `Motion.provenance`: {camera: {"moved": (6,), "std": (6,)}} [m, rad] as `CameraExtrinsics` has them."""

LEFT_OUT = "cameras left out"
"""Key of `Motion.provenance`: {depth camera: [m, rad] by which it would have to be moved and turned}."""

_MIN_MOTION = 1e-9  # [m, rad] below which a camera stayed where it was

LOOKS = 12  # frames that are looked at, spread over the take
_RAYLEIGH = 1.177  # median length of a vector whose two parts have a standard deviation of 1
_MIN_MEASURED_SHARE = 1e-6  # share of a direction that nothing measures


def as_record(found: Sequence[SubjectFit]) -> dict[str, Any]:
    """How far the last of several fits that sought cameras moved them, for `Motion.provenance`."""
    for fit in reversed(found):
        if (cameras := fit.cameras) is not None:
            own = next(own for kind, own in fit.kinds if kind is cameras)
            each = zip(cameras.free, fit.mean[own].reshape(-1, 6), fit.std[own].reshape(-1, 6))
            return {name: {"moved": value.tolist(), "std": s.round(6).tolist()} for name, value, s in each}
    return {}


def between(rig: Rig, other: Rig) -> dict[str, Any]:
    """How the cameras of a rig that stand elsewhere in another one were moved there, as `as_record` has it."""
    moved = {c.name: se3.log(other[c.name].T_camera_world @ se3.inverse(c.T_camera_world)) for c in rig}
    return {name: {"moved": twist.tolist()} for name, twist in moved.items() if np.any(np.abs(twist) > _MIN_MOTION)}


def composed(first: Mapping[str, Any], then: Mapping[str, Any]) -> dict[str, Any]:
    """What two moves in turn amount to, each as `as_record` has it."""
    out = {**first, **then}
    for name in first.keys() & then.keys():
        T = se3.exp(np.array(then[name]["moved"])) @ se3.exp(np.array(first[name]["moved"]))
        out[name] = {**then[name], "moved": se3.log(T).tolist()}
    return out


def sentences(provenance: Mapping[str, Any], errors: CameraErrors | None) -> list[str]:
    """What is worth saying of cameras that were found far from where their calibration has them.

    Parameters
    ----------
    errors : of the calibration
    """
    out = []
    most = np.inf if errors is None else OUTLIER_SIGMAS * np.repeat([errors.position, errors.direction], 3)
    for name, one in provenance.get(CAMERAS, {}).items():
        moved = np.array(one["moved"])
        if np.any(np.abs(moved) > most):
            shift, turn = 1e3 * np.linalg.norm(moved[:3]), np.degrees(np.linalg.norm(moved[3:]))
            out.append(
                f"camera {name} was found {shift:.0f} mm and {turn:.2f} degrees from its calibration, more than the "
                "calibration's error allows: run kinefit check"
            )
    for name, (shift, turn) in provenance.get(LEFT_OUT, {}).items():
        out.append(
            f"depth camera {name} was excluded: its images fit the person only after a rotation by "
            f"{np.degrees(turn):.0f} degrees and a shift by {1e3 * shift:.0f} mm. Correct its pose in the calibration"
        )
    return out


def as_found(rig: Rig, provenance: Mapping[str, Any]) -> Rig:
    """The cameras of a calibration where a motion's fit found them; as they are where it did not seek them."""
    return moved_rig(rig, {name: one["moved"] for name, one in provenance.get(CAMERAS, {}).items()})


def contradictions(scenes: Sequence[Scene], matched: Sequence[Sequence[Matched]]) -> dict[str, dict[str, Any]]:
    """Sensors whose residuals are larger than they can be if they and all others are right.

    Parameters
    ----------
    scenes : of some frames, at the fitted states
    matched : of each, the matches of all sensors

    Returns
    -------
    {sensor: {"deviations": median in stated standard deviations, "median_m": float, "shift_m": [x, y, z]}}
        The worst first; none where the fit has but one sensor, whose residuals contradict no other. `shift_m` is
        where the sensor has its points, beside where all sensors together have them.
    """
    kept: dict[str, list[Rows]] = {}
    for scene, several in zip(scenes, matched):
        for m in several:
            kept.setdefault(m.sensor, []).extend(r for r in rows_at(m, scene) if isinstance(r, Rows))
    if len(kept) < 2:
        return {}
    summaries = {sensor: _summary(rows) for sensor, rows in kept.items() if rows}
    far = {sensor: t for sensor, t in summaries.items() if t["deviations"] > MISFIT_SIGMAS}
    return dict(sorted(far.items(), key=lambda one: -one[1]["deviations"]))


def cameras_apart(residuals: Mapping[str, Residuals], sigma: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Cameras whose keypoints lie far from the fit while those of the others do not: moved, or calibrated otherwise.

    Parameters
    ----------
    residuals : of all sensors
    sigma : {camera: [px]} standard deviation of a sure keypoint, as it is stated

    Returns
    -------
    {camera: {"deviations": float, "median_px": float, "others_px": float}}
        Of three cameras or more; deviations are of what is stated, or of the others' where these are larger.
    """
    medians = {}
    for name, one in residuals.items():
        if name in sigma and one.unit == "px" and np.isfinite(one.norms).any():
            medians[name] = float(np.nanmedian(one.norms))
    found: dict[str, dict[str, Any]] = {}
    for name, median in medians.items() if len(medians) > 2 else ():
        others = float(np.median([m for other, m in medians.items() if other != name]))
        deviations = median / max(_RAYLEIGH * sigma[name], others)
        if deviations > MISFIT_SIGMAS:
            found[name] = {
                "deviations": round(deviations, 2), "median_px": round(median, 1), "others_px": round(others, 1)
            }
    return dict(sorted(found.items(), key=lambda one: -one[1]["deviations"]))


def contradiction_sentences(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The same in words, one for each sensor."""
    return [
        f"{sensor} contradicts the other cameras: half of its keypoints lie {t['median_px']:.0f} px or more from the "
        f"fit, those of the others {t['others_px']:.0f} px. It has a low weight; see kinefit check"
        if "median_px" in t else
        f"{sensor} contradicts the other sensors: half of its residuals exceed {1000 * t['median_m']:.0f} mm, "
        f"{t['deviations']:.1f} of its standard deviations. It is shifted by "
        f"({', '.join(f'{1000 * v:+.0f}' for v in t['shift_m'])}) mm"
        for sensor, t in found.items()
    ]


def _summary(rows: Sequence[Rows]) -> dict[str, Any]:
    data = np.concatenate([np.zeros((8, 0)), *(r.data for r in rows)], axis=1)
    size, square = (np.concatenate([np.zeros(0), *parts]) for parts in zip(*(_points(r) for r in rows)))
    direction, residual, weight = data[3:6], data[6], data[7]
    if not len(size):
        return {"deviations": 0.0, "median_m": 0.0, "shift_m": [0.0, 0.0, 0.0]}
    A = (direction * weight) @ direction.T
    shift = np.linalg.pinv(A, rcond=_MIN_MEASURED_SHARE, hermitian=True) @ (direction @ (weight * residual))
    return {
        "deviations": round(float(np.sqrt(np.median(square))), 2), "median_m": round(float(np.median(size)), 4),
        "shift_m": [round(float(v), 4) for v in shift],
    }  # fmt: skip


def _points(rows: Rows) -> tuple[NDArray, NDArray]:
    """Residual [m] of each measurement in some rows, and its square in variances."""
    felt = rows.weight > 0.0
    ids = np.where(rows.group < 0, rows.group.max(initial=-1) + 1 + np.arange(len(rows)), rows.group)[felt]
    own = np.unique(ids, return_inverse=True)[1]
    residual = rows.residual[felt]
    return np.sqrt(np.bincount(own, residual**2)), np.bincount(own, rows.weight[felt] * residual**2)


_FRAMES = 10  # of the keypoints' fit in which depth images are laid onto the person
_MIN_FRAMES = 4
_WIDE_REACH = 0.45  # [m] about the person: a camera may be off by 3 of 10 cm

Look = tuple[Sequence[Any], Scene]
"""Frames of the sensors at one time, and the body as the keypoints have it then."""


def sensors_of(recording: Recording, settings: TrackSettings, **changes: Any) -> Sensors:
    """The sensors of a recording with the backgrounds that they know, by changed settings."""
    settings = replace(settings, through=np.inf, **changes)
    sensors = Sensors(recording.rig, recording.rate, recording.sigma, settings, on_body=recording.on_body)
    for name, empty in recording.backgrounds.items():
        sensors.know_background(name, empty)
    return sensors


def wide_sensors(recording: Recording, settings: TrackSettings) -> Sensors:
    """The same for a sensor that is off by three of its prior's standard deviations."""
    return sensors_of(recording, settings, reach=_WIDE_REACH, render_every=1)


def measurements_at(look: Look, sensors: Sensors, centre: NDArray, twists: dict[str, NDArray]) -> list[Measurement]:
    """What sensors measured about the person, if each belongs at its twist (7,) about a centre; default: zero."""
    (frames, scene), out = look, list[Measurement]()
    for frame in frames:
        T = displacement(point_cloud.values_of(twists.get(frame.sensor, np.zeros(7))), centre)
        there = scene.at(BodyState(se3.inverse(T) @ scene.state.T_world_root, scene.state.angles))
        out += [Displaced(m, centre) for m in sensors.measurements([frame], there)]
    return out


def registration(
    sensor: str, looks: Sequence[Look], sensors: Sensors, origin: NDArray, centre: NDArray, twist: NDArray | None = None
) -> point_cloud.Registration:
    """What one sensor with its origin (3,) measured about the person, if it belongs at a twist about the centre."""
    own = [([f for f in frames if f.sensor == sensor], scene) for frames, scene in looks]
    own = [look for look in own if look[0]]
    steps = [measurements_at(look, sensors, centre, {} if twist is None else {sensor: twist}) for look in own]
    prior = SensorFrames((sensor,), POSE_SIGMAS, {sensor: origin - centre}).information
    return point_cloud.Registration(sensor, steps, [scene for _, scene in own], centre, prior[:6, :6])


def placed_cameras(recording: Recording, subject: Subject, settings: TrackSettings) -> dict[str, SensorAlignment]:
    """{depth camera: where it belongs} of those without keypoints, by the poses of the keypoints' subject fit."""
    if subject.fit is None or not subject.body.surfaces:
        return {}
    videos = {k.camera for k in recording.keypoints}
    looks: dict[str, list[Look]] = {}
    for k in spread(len(subject.frames), _FRAMES):
        for frame in by_record(recording.steps(subject.frames[k]))[DepthFrame]:
            if recording.rig[frame.sensor].name not in videos:
                state, samples = subject.fit.states[k], settings.samples
                scene = Scene(subject.body, state, recording.rig, time=frame.time, samples=samples)
                looks.setdefault(frame.sensor, []).append(([frame], scene))
    sensors = wide_sensors(recording, settings)
    return {
        name: placed_camera(name, own, sensors, recording.rig[name].T_camera_world, _middle(own))[0]
        for name, own in looks.items() if len(own) >= _MIN_FRAMES
    }  # fmt: skip


def placed_camera(
    sensor: str, looks: Sequence[Look], sensors: Sensors, T_camera_world: NDArray, centre: NDArray, *,
    thorough: bool = False,
) -> tuple[SensorAlignment, point_cloud.Ends | None]:  # fmt: skip
    """Where one depth camera belongs, and the ends of all starts, if the stated pose is not near or if `thorough`."""
    origin, still = se3.inverse(T_camera_world)[:3, 3], np.zeros(7)
    stated = registration(sensor, looks, sensors, origin, centre)
    covariance, ends = np.diag(np.repeat(POSE_SIGMAS, (3, 3, 1)) ** 2), None
    twist = still if thorough else stated.settled(still, point_cloud.FINE_DISTANCES)
    found = SensorAlignment(sensor, "depth", twist, covariance, centre)
    if thorough or not found.is_near:
        reach = *point_cloud.COARSE_DISTANCES, *point_cloud.FINE_DISTANCES
        starts = point_cloud.starts(origin, centre, POSE_SIGMAS[:2])
        ends = point_cloud.Ends(stated, tuple(stated.settled(s, reach) for s in starts))
        found = replace(found, twist=ends.best)
    axis = np.pi * T_camera_world[2, :3]
    way = centre - origin
    over = np.concatenate([se3.exp_so3(axis) @ way - way, axis, [0.0]])
    rolled = registration(sensor, looks, sensors, origin, centre, over)
    over = rolled.settled(over, point_cloud.FINE_DISTANCES)
    if point_cloud.clearly_above(stated.costs(found.twist), rolled.costs(over)):
        return replace(found, twist=over), None
    return replace(found, falls=stated.above(still, found.twist)), ends


def _middle(looks: Sequence[Look]) -> NDArray:
    """(3,) [m] mean of the joints in some scenes."""
    states = [scene.state for _, scene in looks]
    roots, angles = np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states])
    return np.asarray(looks[0][1].body.tree.segment_poses(roots, angles)[:, :, :3, 3].mean(axis=(0, 1)))
