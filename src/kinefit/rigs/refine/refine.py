"""Refine cameras by a tracked person: bundle adjustment over poses, bone lengths and cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked, renamed
from kinefit.bodies import Body
from kinefit.errors import CalibrationError, ObservationError, TrackingError
from kinefit.fitting.subject.subject import Progress
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate
from kinefit.observations import KEYPOINT_SIGMA, Keypoints
from kinefit.rigs.refine import result
from kinefit.rigs.refine.gauge import aligned, resized
from kinefit.solving.bundle.adjust import BundleState, adjust
from kinefit.solving.bundle.cameras import COLUMNS, FOCAL, POSE, RADIAL, TIME, CameraPrior, PointPixels, departure
from kinefit.solving.bundle.shape import BodyProblem

PLACE_SIGMA = 0.05
"""[m] of a camera's calibrated centre: a tripod that was knocked, not a camera that was moved."""
TURN_SIGMA = np.radians(2.0)
"""[rad] of a camera's calibrated rotation, likewise."""
_FOCAL_SIGMA = 0.03  # share
_RADIAL_SIGMA = 0.05
_TIME_SIGMA = 0.2  # [s]
_STATIC_SIGMA_PX = 1.0  # of a manually annotated point
_RAYLEIGH_MEDIAN = 1.177  # of the length of a normal error in the plane, in σ
_MAX_SIGMA_PX = 30.0  # of keypoints; with more, points of different cameras do not match
_MAX_FRAMES = 600
_MIN_FRAMES = 10
_MAX_ROUNDS = 3
_MAX_CLOCK_ROUNDS = 6  # clocks converge slowly: velocities are from unsynchronised frames
_CONVERGED_STEP = 2e-4  # [m, rad] 0.3 px: tracking again would give the same result
_CONVERGED_FRAMES = 0.02  # of the clocks, likewise
_MAX_UNCERTAINTY_PX = 10.0  # with more, the refined calibration is no better than the given one
_MAX_POINT_STD = 0.05  # [m] likewise: a tripod that was knocked
_FROM_SCRATCH_FACTOR = 10.0  # on these limits, if no poses were known: half a metre, which the error bars report
_MAX_FOCAL_STD = 0.2  # of a focal length: with more, people are a fifth nearer, as with a guess
_MAX_RESIDUAL = 0.02  # of the image's diagonal: a camera with more is another one, or elsewhere


StaticPoints = Mapping[str, Mapping[str, tuple[float, float]]]
Length = tuple[str, str, float]
Gauge = Callable[[Rig, result.PersonSighting], tuple[Rig, str]]


@renamed(accuracy="sigma")
@checked
def refine(
    rig: Rig,
    keypoints: Sequence[Keypoints],
    body: Body,
    *,
    focal: bool = False,
    distortion: bool = False,
    time_offsets: bool = False,
    static_points: StaticPoints | None = None,
    height: float | None = None,
    known_length: Length | None = None,
    up: str = "z",
    sigma: float = KEYPOINT_SIGMA,
    progress: Progress | None = None,
) -> result.Refinement:
    """Refine a rig by the person in view, and by static points if given.

    A robust bundle adjustment estimates poses, bone lengths, landmark offsets and cameras jointly. Then the person is
    tracked again with the refined cameras; at most three rounds, six with time offsets.

    Parameters
    ----------
    rig : Rig, accurate to 5 cm and 2° for each camera (standard deviations of the prior).
    keypoints : records of the same number of frames and the same rate.
    body : Body, generic.
    focal, distortion, time_offsets : bool
        Whether to estimate focal lengths (one factor a camera), k1 and k2, time offsets. Principal points stay fixed.
    static_points : {name: {camera: (u, v)}} [px] in the calibration's image, of static objects.
    height : float [m] stature of the person: sets the scale.
    known_length : (point, point, [m]): sets the scale; static points or keypoints of the body.
    sigma : float [px] standard deviation of a keypoint of full confidence.

    Raises
    ------
    CalibrationError
        Too little motion, or too few common views, for an uncertainty below 10 px; cameras that do not fit.
    ObservationError
        Streams that differ; an impossible height, length or static point.
    """
    check_input(rig, keypoints, height, known_length, static_points)
    prior_std = prior_sigma(len(rig), focal=focal, distortion=distortion, time_offsets=time_offsets)

    def gauge(new: Rig, seen: result.PersonSighting) -> tuple[Rig, str]:
        return _in_old_frame(new, rig, seen, static_points or {}, height, known_length)

    trial, prior = result.PersonTrial(keypoints, body, up, sigma), CameraPrior(rig, prior_std)
    return refine_from(rig, trial, prior, gauge, static_points=static_points, progress=progress)


def prior_sigma(cameras: int, *, focal: bool, distortion: bool, time_offsets: bool) -> NDArray:
    """(C, 16) prior standard deviations of each parameter of calibrated cameras; 0 fixes a parameter."""
    prior_std = np.zeros((cameras, COLUMNS))
    prior_std[:, :3], prior_std[:, 3:6] = PLACE_SIGMA, TURN_SIGMA
    prior_std[:, FOCAL] = _FOCAL_SIGMA * focal
    prior_std[:, RADIAL] = _RADIAL_SIGMA * distortion
    prior_std[:, TIME] = _TIME_SIGMA * time_offsets
    return prior_std


def refine_from(
    rig: Rig, trial: result.PersonTrial, prior: CameraPrior, gauge: Gauge, *, static_points: StaticPoints | None = None,
    free: PointPixels | None = None, progress: Progress | None = None, from_scratch: bool = False,
) -> result.Refinement:  # fmt: skip
    """Refine as `refine`, from any start with any prior.

    `gauge` transforms the rig to its final frame, and returns the rule as text; `free` are pixels of further points
    without a prior.
    """
    step = progress or (lambda *_: None)
    names, static = result.static_pixels(rig, static_points or {}, _STATIC_SIGMA_PX)
    if free is not None and len(free.point):
        both = ((static.camera, free.camera), (static.point, len(names) + free.point), (static.uv, free.uv),
                (static.weight, free.weight))  # fmt: skip
        static = PointPixels(*map(np.concatenate, both))
    offsets = np.zeros(len(rig))
    first: result.PersonSighting | None = None
    rounds = _MAX_CLOCK_ROUNDS if prior.free[:, TIME].any() else _MAX_ROUNDS
    for turn in range(rounds):
        step("refining", turn, rounds + 1)
        seen = _sight(rig, trial, offsets)
        first = first or seen
        residual_sigma = float(np.nanmedian(np.linalg.norm(seen.residuals, axis=-1))) / _RAYLEIGH_MEDIAN
        if residual_sigma > 2.0 * trial.sigma:  # else the loss rejects most points
            seen = _sight(rig, replace(trial, sigma=min(residual_sigma, _MAX_SIGMA_PX)), offsets)
        chosen = result.spread_frames(seen, _MAX_FRAMES)
        _check_frames(seen, chosen)
        pixels, (model, theta) = result.pixel_frames(seen, chosen), result.body_model(seen, trial.body)
        states = [seen.motion.state(int(f)) for f in chosen]
        start = BundleState(rig, np.zeros(len(rig)), static_start(rig, static), theta, states)
        problem = BodyProblem(static, model=model, frames=pixels)
        bundle = adjust(start, prior, problem, iterations=20, tolerance=1e-3)
        change = np.abs(departure(bundle.state.rig, rig)[:, POSE]).max(), np.abs(np.ptp(bundle.state.offsets))
        rig, offsets = bundle.state.rig, offsets + bundle.state.offsets
        offsets = offsets - offsets[0]
        if change[0] < _CONVERGED_STEP and change[1] * seen.motion.rate < _CONVERGED_FRAMES:
            break
    else:  # the last adjustment may have changed the scale, which the gauge takes from the person
        seen = _sight(rig, trial, offsets)
    step("refining", rounds, rounds + 1)
    covariance = result.chance(bundle, seen, chosen) + result.bias(problem, bundle)
    rig, rule = gauge(rig, seen)
    last = _sight(rig, trial, offsets)
    assert first is not None
    changes, distance = result.changes_of(prior.rig, rig, first, last, covariance, offsets)
    step("refining", rounds + 1, rounds + 1)
    check_result(rig, changes, distance, times=_FROM_SCRATCH_FACTOR if from_scratch else 1.0)
    static_residuals = _static_residuals(rig, static, names)
    return result.Refinement(
        rig, dict(zip(rig.names, offsets.tolist(), strict=True)), changes, rule, chosen,
        all(c.uncertainty <= result.MAX_STATIC_SIGMA_PX for c in changes.values()), last.motion, distance,
        static_residuals, from_scratch,
    )  # fmt: skip


def _sight(rig: Rig, trial: result.PersonTrial, offsets: NDArray) -> result.PersonSighting:
    try:
        return result.sight(rig, trial, dict(zip(rig.names, offsets.tolist(), strict=True)))
    except TrackingError as error:
        raise CalibrationError(
            f"the cameras agree on no person ({error.problem})",
            remedy="Check that the calibration is of this recording and that no two cameras are swapped; "
            "`kinefit calibrate people` needs no poses of the cameras at all.",
        ) from error


def static_start(rig: Rig, static: PointPixels) -> NDArray:
    """(P, 3) [m] static points triangulated with a rig."""
    count = int(static.point.max(initial=-1)) + 1
    uv = np.full((count, len(rig), 2), np.nan)
    uv[static.point, static.camera] = static.uv
    return triangulate(rig, uv)


def _static_residuals(rig: Rig, static: PointPixels, names: tuple[str, ...]) -> dict[str, float]:
    x, out = static_start(rig, static), {}
    for p, name in enumerate(names):
        own = static.point == p
        seen = zip(static.camera[own], static.uv[own], strict=True)
        out[name] = float(np.median([np.linalg.norm(rig.cameras[c].project(x[p]) - uv) for c, uv in seen]))
    return out


def _in_old_frame(
    rig: Rig, old: Rig, seen: result.PersonSighting, static: StaticPoints, height: float | None,
    known_length: Length | None,
) -> tuple[Rig, str]:
    """The rig in the old frame with the known scale, and the rule as text."""
    rule = "The world is the old calibration's: all cameras together stay as near as possible to their old poses"
    if known_length is not None:
        a, b, metres = known_length
        names, pixels = result.static_pixels(rig, static, _STATIC_SIGMA_PX)
        if a in names and b in names:
            x = static_start(rig, pixels)
            length = float(np.linalg.norm(x[names.index(a)] - x[names.index(b)]))
        else:
            length = length_of(seen, a, b)
        text = f", and {a} to {b} is {metres:g} m long"
    elif height is not None and seen.motion.body.stature > 0:
        length, metres = seen.motion.body.stature, height
        text = f", and the person is {height:g} m tall"
    else:
        return aligned(rig, old)[0], f"{rule}, in position, rotation and scale."
    return aligned(resized(rig, metres / length), old, scale=False)[0], f"{rule} in position and rotation{text}."


def length_of(seen: result.PersonSighting, a: str, b: str) -> float:
    """Median distance [m] between two keypoints of the tracked person."""
    x = seen.motion.positions(seen.channels.with_points(seen.motion.body).points.select((a, b)))
    return float(np.median(np.linalg.norm(x[:, 0] - x[:, 1], axis=1)))


def check_input(
    rig: Rig, keypoints: Sequence[Keypoints], height: float | None, known_length: Length | None,
    static: StaticPoints | None = None,
) -> None:  # fmt: skip
    """Check the input of `refine`: rig, streams, height and length [m], static points (u, v) [px].

    Raises
    ------
    CalibrationError, ObservationError
        As `refine`.
    """
    unseen = [name for name in rig.names if name not in {k.camera for k in keypoints}]
    if len(rig) < 2 or unseen:
        raise CalibrationError(
            f"no keypoints of camera {', '.join(unseen)}" if unseen else "one camera alone cannot be refined",
            remedy="Give keypoints of every camera, and two cameras or more.",
        )
    if len({(len(k), k.rate) for k in keypoints}) > 1:
        listed = ", ".join(f"{k.camera}: {len(k)} frames at {k.rate:g} Hz" for k in keypoints)
        raise ObservationError(f"keypoint streams differ ({listed})", remedy="Set frames or rate in the take.")
    if height is not None and not 0.3 < height < 3.0:
        raise ObservationError(f"a height of {height:g} m", remedy="Give the person's height in metres.")
    if known_length is not None and not 1e-3 < known_length[2] < 100.0:
        raise ObservationError(f"a length of {known_length[2]:g} m", remedy="Give it in metres.")
    for name, views in (static or {}).items():
        flat = np.array(list(views.values()), float)
        if len(views) < 2 or flat.shape != (len(views), 2) or not np.isfinite(flat).all():
            raise ObservationError(
                f"the static point {name} is not given as (u, v) in two cameras or more",
                remedy="Give {camera: (u, v)} in pixels of the calibration's image.",
            )
        for camera in views:
            rig.index(camera)


def _check_frames(seen: result.PersonSighting, frames: NDArray) -> None:
    if len(frames) < _MIN_FRAMES:
        raise CalibrationError(
            f"only {len(frames)} of {len(seen.motion)} frames show the person well enough to refine the cameras",
            remedy="Record someone who walks through the whole volume for ten seconds, seen by all cameras.",
        )


def check_result(rig: Rig, changes: Mapping[str, result.CameraChange], distance: float, *, times: float = 1.0) -> None:
    """Check that refined cameras fit the keypoints, and that the recording determines them.

    Parameters
    ----------
    distance : float [m] standard deviation of a triangulated point near the person.
    times : factor on the limits of uncertainty.

    Raises
    ------
    CalibrationError
        Cameras that do not fit, or undetermined lenses or poses.
    """
    wrong = [
        name for name, c in changes.items()
        if not c.residual_after < _MAX_RESIDUAL * float(np.hypot(*rig[name].size))
    ]
    if wrong:
        listed = ", ".join(f"{name} ({changes[name].residual_after:.0f} px)" for name in wrong)
        raise CalibrationError(
            f"after refinement the body still does not fit these cameras: {listed}",
            remedy="Check whether two cameras are swapped, the calibration is of another session or the cameras are "
            "out of step; `kinefit calibrate people` starts from no poses at all.",
        )
    loose = [name for name, c in changes.items() if not c.focal_std <= _MAX_FOCAL_STD]
    if loose:
        shares = ", ".join(f"{name} to {100 * changes[name].focal_std:.0f} %" for name in loose)
        raise CalibrationError(
            f"the motion does not determine the lenses: focal lengths would be known in {shares}",
            place=f"camera {loose[0]}",
            remedy="Record someone in full view who walks towards the cameras and away, and raises the arms; or state "
            "field_of_view, or calibrate the lenses with a board.",
        )  # fmt: skip
    unknown = [name for name, c in changes.items() if not c.uncertainty <= times * _MAX_UNCERTAINTY_PX]
    if unknown or not distance <= times * _MAX_POINT_STD:
        listed = ", ".join(f"{name} to {changes[name].uncertainty:.0f} px" for name in unknown)
        listed = listed or f"space to {1e3 * distance:.0f} mm"
        raise CalibrationError(
            f"too little motion to refine: static points about the person would be known in {listed}",
            remedy="Record someone who walks through the whole volume, turns and raises the arms, seen by all cameras; "
            "or give static points.",
        )
