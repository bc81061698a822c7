"""Smooth a whole take: fit all frames jointly, with a motion prior whose process noise is estimated from the take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._threads import side_by_side
from kinefit.bodies import Body, BodyState
from kinefit.findings import runs_of
from kinefit.fitting.frame.results import UNOBSERVED_STD_RATIO, FrameResult, frame_result, frame_results, unknown_joints
from kinefit.fitting.smoothing.border import Border, parts, solved, solved_with_covariances, with_border
from kinefit.fitting.smoothing.foot_contacts import find_contacts
from kinefit.fitting.smoothing.process_noise import SmoothTake, estimate, estimate_activity
from kinefit.fitting.smoothing.spool import MATRIX_FRAMES, Spool, stretches
from kinefit.fitting.smoothing.tracked_frames import TrackedFrames
from kinefit.fitting.smoothing.unwrap import unwrap
from kinefit.sensors.base import Matched
from kinefit.sensors.evidence import moves_points, near
from kinefit.sensors.points.keypoints import pixels_of
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.closed import Constraint, on_null_space, onto
from kinefit.solving.correspondences.closures import hard_equations, looped
from kinefit.solving.equations import variances
from kinefit.solving.trajectory.smoothing import unpacked

_NOISE_PARTS = 6  # of a long take, from which its process noise is estimated
_MIN_PIXELS = 6  # of a frame, with half the rows of other points; a frame with fewer is lost
_CONTACT_ROUNDS = 2  # of finding foot contacts, the second with the contacts of the first
_UNKNOWN_TIME = 0.13  # [s] about a contradicted segment: of 0, 0.13 and 0.27, the first misses the ends of a gap


@dataclass(frozen=True, eq=False)
class SmoothedTake:
    """A smoothed take.

    Parameters
    ----------
    results : F frames, with the matches of keypoints alone; read on demand
    take : SmoothTake at the solution
    matched : F lists, the matches of all sensors but keypoints and packed markers; None if there are none
    provenance : estimated noise, for `Motion.provenance`
    border : the sensors' own unknowns as the whole take tells them; None where there are none
    """

    results: Sequence[FrameResult]
    take: SmoothTake
    matched: Sequence[tuple[Matched, ...]] | None
    provenance: dict[str, Any]
    border: Border | None = None


def smooth_results(
    frames: TrackedFrames, *, contacts: bool = False, up: str = "z",
    eye: NDArray | None = None, level: bool = True, windows: tuple[int, int] = (300, 60), border: Border | None = None,
) -> SmoothedTake:  # fmt: skip
    """Smooth tracked frames of any sensors jointly.

    Outliers and left-right swaps are those of the track, decided again once. Correspondences of sensors other than
    keypoints and labelled markers are matched again in every round.

    Parameters
    ----------
    contacts : bool
        Constrain the soles to rest while they touch a level floor; `up` is the world's vertical axis.
    eye : (3,) [m] centre of the camera, if it is the only sensor, see `find_contacts`. The noise of its keypoints is
        then never estimated below the stated one, since no other view shows their systematic errors.
    level : bool, `up` is measured, so that the floor is level
    windows : number of frames that are solved at a time, and that two neighbouring windows share
    border : the sensors' own unknowns, to start from
    """
    body, settings = frames.tracker.body, frames.tracker.settings
    take = replace(_take(as_tracked(frames), settings), one_view=eye is not None)
    take, rounds = _estimate(take, settings, *windows)
    if border is not None and take.others is not None:
        take, border = with_border(take, border, *windows)
    take, covariances, others_matched = solved_with_covariances(take, *windows)
    swaps = take.pixels.find_swaps(body, take.roots, take.angles)
    if not np.array_equal(swaps, take.pixels.swapped):
        take = replace(take, pixels=take.pixels.swapped_as(swaps, body, take.roots, take.angles))
        take, covariances, others_matched = solved_with_covariances(take, *windows)
    for _ in range(_CONTACT_ROUNDS if contacts else 0):  # covariances stay those without: a contact is no measurement
        found = find_contacts(body, take.roots, take.angles, frames.tracker.rate, up, eye, level=level)
        take, others_matched = solved(replace(take, contacts=found), *windows)
    take = replace(take, angles=unwrap(body.tree, take.angles))
    hard = hard_equations(body)
    take = take if hard is None else _closed(take, hard)
    smoothed = _results(take, frames, covariances, others_matched, hard)
    return SmoothedTake(smoothed, take, others_matched, _provenance(take, rounds), border)


def _results(
    take: SmoothTake, frames: TrackedFrames, covariances: Sequence[NDArray],
    others: Sequence[tuple[Matched, ...]] | None, hard: Constraint | None,
) -> Spool[FrameResult]:  # fmt: skip
    """The frames of a solved take, with the matches of keypoints alone; `others` are the matches of all others."""
    body, markers = take.body, take.markers
    out, surfaces, packed = Spool[FrameResult](), False, np.triu_indices(body.tree.n_dofs)
    for some in stretches(len(take.roots), MATRIX_FRAMES):
        several = range(*some.indices(len(take.roots)))
        covariance = np.empty((len(several), body.tree.n_dofs, body.tree.n_dofs))
        for own, f in zip(covariance, several):
            own[packed] = own.T[packed] = covariances[f]
            if hard is not None:
                own[:] = on_null_space(own, hard(BodyState(take.roots[f], take.angles[f]))[1])
        tracked = [frames.results[f] for f in several]
        if others is None and not len(take.pixels.points):
            part = markers.part(some)
            at = take.roots[some], take.angles[some]
            states = [BodyState(root, q) for root, q in zip(*at)]
            made = frame_results(
                body, states, frames.times[some], covariance, part.evidence(body, part.gaps(body, *at)),
                observed=take.observed[some], iterations=[r.iterations for r in tracked],
            )  # fmt: skip
        else:
            made = [_result(take, frames, f, r, own, others) for f, r, own in zip(several, tracked, covariance)]
            surfaces |= any(m.shows_surface for f in several for m in (() if others is None else others[f]))
        for result in made:
            out.append(result)
    return _with_unknown_joints(body, out, round(_UNKNOWN_TIME * frames.tracker.rate)) if surfaces else out


def _result(
    take: SmoothTake, frames: TrackedFrames, f: int, tracked: FrameResult, covariance: NDArray,
    others: Sequence[tuple[Matched, ...]] | None,
) -> FrameResult:  # fmt: skip
    """Frame f of a solved take, from what the tracker found in it."""
    state = BodyState(take.roots[f], take.angles[f])
    if take.others is None:
        scene = frames.tracker.scene_of(state, tracked.time)
    else:
        scene = take.others.scene(f, take.roots, take.angles)
    points = [m for block in take.blocks for m in block.matched(f, tracked.matched, scene)]
    matched = (*points, *(() if others is None else others[f]))
    frame = frame_result(scene, covariance, matched, tracked.iterations, observed=take.observed[f])
    return replace(frame, matched=tuple(pixels_of(points)), measurements=())


def _closed(take: SmoothTake, hard: Constraint) -> SmoothTake:
    """The take with closures closed exactly; the solution has them as rows with a sigma of a tenth of a millimetre."""
    roots, angles = np.array(take.roots), np.array(take.angles)
    for f in range(len(roots)):
        state, _ = onto(take.body, BodyState(roots[f], angles[f]), hard, limits=False)
        roots[f], angles[f] = state.T_world_root, state.angles
    return replace(take, roots=roots, angles=angles)


def _with_unknown_joints(body: Body, results: Sequence[FrameResult], half: int) -> Spool[FrameResult]:
    """Frames with infinite standard deviations of `unknown_joints` and their coordinates."""
    lost, hidden = map(np.stack, zip(*((r.lost, r.hidden) for r in results)))
    unknown = unknown_joints(body.tree, lost, hidden, half)
    of_dofs = np.concatenate([np.zeros((len(unknown), 6), bool), unknown[:, body.tree.owners]], axis=1)
    return Spool(
        replace(
            r, joint_std=np.where(joints[:, None], np.inf, r.joint_std), dof_std=np.where(dofs, np.inf, r.dof_std)
        )
        for r, joints, dofs in zip(results, unknown, of_dofs)
    )  # fmt: skip


def as_tracked(frames: TrackedFrames) -> SmoothTake:
    """Measurements of tracked frames with the tracker's swaps and states, not smoothed."""
    results, body, settings = frames.results, frames.tracker.body, frames.tracker.settings
    roots, angles = map(np.stack, zip(*((r.state.T_world_root, r.state.angles) for r in results)))
    all_observed = np.ones((len(roots), len(body.tree.coordinates)), bool)
    pixels = frames.packed_pixels(roots, angles)
    markers, others, n = frames.packed_markers(), None, body.tree.n_dofs
    packed = markers.sensors
    sensors = dict.fromkeys((m.sensor for r in results for m in r.measurements if m.sensor not in packed), 1.0)
    if sensors or body.closures:
        rows = 2 * np.count_nonzero(pixels.channels.weight, axis=1) + 3 * np.count_nonzero(markers.seen, axis=1)
        others = replace(frames, packed=packed, points=rows, scale=sensors)
    acceleration = np.where(np.arange(n) < 3, settings.root_acceleration, settings.angle_acceleration)
    return SmoothTake(
        body, pixels, markers, roots, angles, all_observed, acceleration, np.ones((len(roots), n)),
        1.0 / frames.tracker.rate, (settings.acceleration_memory, settings.smooth_memory), others=others,
        looked=1.0 if frames.looked is None else max(float(frames.looked.mean()), 1.0 / len(roots)),
    )  # fmt: skip


def _take(take: SmoothTake, settings: TrackSettings) -> SmoothTake:
    """The take with continuous angles, lost frames filled, and its observed coordinates."""
    body, pixels, rate = take.body, take.pixels, 1.0 / take.dt
    inliers = pixels.inliers(body, take.roots, take.angles)
    alone, rows = _observed(take)
    moves_keypoint = moves_points(body, pixels.points, inliers, take.roots, take.angles)
    observed = alone[0] & (moves_keypoint | looped(body)) | alone[1]
    lost = inliers.sum(axis=1) + 0.5 * rows < _MIN_PIXELS
    roots, angles = bridged(take.roots, unwrap(body.tree, take.angles), lost, settings.smooth_memory * rate)
    observed = near(observed, round(settings.smooth_memory * rate))
    return replace(take, roots=roots, angles=angles, observed=observed)


def _observed(take: SmoothTake) -> tuple[list[NDArray], NDArray]:
    """Coordinates (F, D) that each frame observes: by all sensors, by all but keypoints; rows of the latter (F,)."""
    tree, (T, D) = take.body.tree, take.angles.shape
    prior = np.diag(np.concatenate([np.full(6, 1.0), 1.0 / np.square(tree.spread)]))
    out, rows = [np.zeros((T, D), bool), np.zeros((T, D), bool)], np.zeros(T)
    for some in stretches(T, MATRIX_FRAMES):
        part = take.part(some)
        points = part.solver_points()
        kinds = [points, replace(points, weight=np.zeros_like(points.weight))]
        found = [unpacked(of.equations(take.body)(part.roots, part.angles)[0], tree) for of in kinds]
        rows[some] = 3 * np.count_nonzero(part.markers.inliers(part.body, part.roots, part.angles), axis=1)
        if take.others is not None:
            linear = take.others.linearised(take.roots, take.angles, frames=range(some.start, some.stop))
            found, rows[some] = [H + linear.H for H in found], rows[some] + linear.rows
        for observed, matrices in zip(out, found):
            variance = np.array([variances(H + prior)[6:] for H in matrices])
            observed[some] = variance <= np.square(UNOBSERVED_STD_RATIO * tree.spread)
    return out, rows


def _estimate(
    take: SmoothTake, settings: TrackSettings, window: int, overlap: int
) -> tuple[SmoothTake, int]:
    """Estimate the noise from a few parts of the take; returns the take with it and its activity, and the rounds."""
    windows = [whole for whole, _ in parts(len(take.roots), window, overlap)]
    chosen = np.unique(np.linspace(0, len(windows) - 1, _NOISE_PARTS).round().astype(int))
    pieces, rounds = estimate([take.part(windows[i]) for i in chosen], settings.smooth_rounds)
    done, noise = dict(zip(chosen.tolist(), pieces, strict=True)), pieces[0].pixels
    pixels = take.pixels.with_noise(noise.sigma, noise.errors.share)
    take = replace(take, acceleration=pieces[0].acceleration, pixels=pixels).scaled(pieces[0].scale)
    roots, angles, live = np.array(take.roots), np.array(take.angles), np.array(take.live)
    left = (take.part(whole) for i, whole in enumerate(windows) if i not in done)
    found = map(estimate_activity, left) if take.others is not None else side_by_side(estimate_activity, left)
    for i, (whole, kept) in enumerate(parts(len(take.roots), window, overlap)):
        piece = done[i] if i in done else next(found)
        take.pixels.release()
        inside = slice(kept.start - whole.start, kept.stop - whole.start)
        roots[kept], angles[kept], live[kept] = piece.roots[inside], piece.angles[inside], piece.live[inside]
    return replace(take, roots=roots, angles=angles, live=live), rounds


def _provenance(take: SmoothTake, rounds: int) -> dict[str, Any]:
    coordinates, pixels = ("root_shift", "root_turn", *take.body.tree.coordinates), take.pixels
    values, points, share = [take.acceleration[0], *take.acceleration[5:]], pixels.points, pixels.errors.share
    of_source = {q: np.flatnonzero(pixels.channels.source == k) for k, q in enumerate(pixels.channels.sources)}
    speeds = {} if take.speed_std is None else dict(zip(take.body.dof_names, take.speed_std.round(4).tolist()))
    return {
        "acceleration": {name: float(f"{v:.4g}") for name, v in zip(coordinates, values, strict=True)},
        "acceleration_memory": take.memory[0],
        "velocity_memory": take.memory[1],
        "speed_std": speeds,
        "pixel_sigma": {
            label: {points.names[i]: round(float(pixels.sigma[i]), 2) for i in own} for label, own in of_source.items()
        },
        "shared_errors": {
            label: {take.body.tree.segments[points.segments[i]]: round(float(share[i]), 2) for i in own if share[i] > 0}
            for label, own in of_source.items()
        },
        "sigma_factor": {name: round(v, 2) for name, v in take.scale.items()},
        "liveliest": round(float(take.live.max()), 2),
        "contacts": 0 if take.contacts is None else int(np.any(take.contacts.weight > 0, axis=1).sum()),
        "rounds": rounds,
    }


_VELOCITY_FRAMES = 5  # over which the velocity at the ends of a gap is measured


def bridged(roots: NDArray, angles: NDArray, lost: NDArray, memory: float) -> tuple[NDArray, NDArray]:
    """Poses with lost frames filled: a blend of both extrapolations, from before and from after the gap.

    So a person who turns round in a gap turns on in the same direction, not back.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad] without jumps
    lost : (F,) bool
    memory : float [frames], time constant with which an extrapolated velocity decays
    """
    roots, angles = np.array(roots), np.array(angles)
    for start, stop in runs_of(lost):
        before = _edge_of_gap(roots, angles, lost, start - 1, -1)
        after = _edge_of_gap(roots, angles, lost, stop, 1)
        for f in range(start, stop):
            share = (f - start + 1) / (stop - start + 1)
            state = None
            if before:
                state = before[0].retract(_decayed_frames(f - start + 1, memory) * before[1])
            if after:
                backward = after[0].retract(_decayed_frames(stop - f, memory) * after[1])
                weight = share * share * (3.0 - 2.0 * share)
                state = state.retract(weight * state.difference(backward)) if state else backward
            if state:
                roots[f], angles[f] = state.T_world_root, state.angles
    return roots, angles


def _decayed_frames(frames: float, memory: float) -> float:
    """Integral of a decaying velocity over some frames, in frames of its start."""
    return memory * float(-np.expm1(-frames / memory))


def _edge_of_gap(
    roots: NDArray, angles: NDArray, lost: NDArray, f: int, towards: int
) -> tuple[BodyState, NDArray] | None:
    """State of frame `f` at the edge of a gap, and its step (n,) per frame into the gap; None outside the take."""
    if not 0 <= f < len(roots):
        return None
    state, steps = BodyState(roots[f], angles[f]), 0
    while steps < _VELOCITY_FRAMES and 0 <= (k := f + towards * (steps + 1)) < len(roots) and not lost[k]:
        steps += 1
    if steps == 0:
        return state, np.zeros(6 + angles.shape[1])
    inside = f + towards * steps
    return state, BodyState(roots[inside], angles[inside]).difference(state) / steps
