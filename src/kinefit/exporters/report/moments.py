"""Doubtful moments of a motion: when, which segments, how much, and why in plain words; the worst first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from kinefit.bodies import Body
from kinefit.bodies.limbs import finger_groups
from kinefit.bodies.motion import Motion, Residuals
from kinefit.exporters.tables import DIGITS, split_side
from kinefit.findings import listed, runs_of

DOUBT_DISTANCE_M = 0.05  # [m] from the truth: about half as thick as a limb, which then is drawn outside itself
_DOUBTFUL = 0.5  # probability that an end is farther off, above which a segment is doubtful
_MAX_CONTRADICTION_M = 0.08  # [m] of points away from the fit; of 91 segments beyond it in simulations 11 were wrong
_MIN_VARIANCE_M2 = 1e-12  # of an end that is exact
_FLAT_ROOT_SIGMA = 1.0  # [m, rad] of a root that nothing holds
_MAX_STD = 1e3  # [rad, m] of a coordinate without a prior
_WINDOW = 0.05  # [s] to either side, in which most views must contradict: an outlier is alone

POORLY_SUPPORTED = 0.5  # quality below which the measurements support less than half of the body
_GAP = 0.1  # [s] stretches nearer than this are one to somebody who looks at the video
_MIN_OUTLIER_SHARE = 0.25  # reported as a cause; fits of good keypoints reject less than a tenth


def doubtful(likely: NDArray, against: NDArray) -> NDArray:
    """(F, S) bool: segments of which an end is rather more than 5 cm off than not, or is so in most views.

    By `probably_far` and `contradicted`.
    """
    return np.asarray((likely > _DOUBTFUL) | against)


def probably_far(variances: NDArray) -> NDArray:
    """(F, S) probability that the less certain end of each segment is more than 5 cm off, by `end_variances`.

    The square of the distance is a sum of three squared normal errors; it counts as a gamma distribution of the same
    mean and variance (Satterthwaite 1946, Biometrics Bulletin 2:110).
    """
    variances = np.maximum(variances, _MIN_VARIANCE_M2)
    mean, twice = variances.sum(axis=-1), 2.0 * np.square(variances).sum(axis=-1)
    return np.asarray(gammaincc(mean**2 / twice, DOUBT_DISTANCE_M**2 * mean / twice))


def uncertain_throughout(motion: Motion) -> dict[str, float]:
    """Segments with an end that is rather more than 5 cm off in most frames, and its median sigma [m]."""
    if not motion.residuals or not len(motion):
        return {}
    variances, bare = end_variances(motion), 2 * unmarked(motion).sum(axis=0) > len(motion)
    often = np.median(probably_far(variances), axis=0) > _DOUBTFUL
    sigma = np.median(np.sqrt(variances.sum(axis=-1)), axis=0)
    return {name: float(sigma[s]) for s, name in enumerate(motion.body.tree.segments) if often[s] and not bare[s]}


def unmarked(motion: Motion) -> NDArray:
    """(F, S) bool: segments that are not observed, as no marker on them is seen and no other sensor looked."""
    bare = motion.lost & (motion.quality > 0)[:, None]
    markers = [r for r in motion.residuals.values() if r.of_points and r.unit == "m"]
    if not markers or len(markers) < len(motion.residuals):
        return np.zeros_like(bare)
    for r in markers:
        for s in np.unique(r.segments):
            bare[:, s] &= ~np.isfinite(r.norms[:, r.segments == s]).any(axis=1)
    return bare


def end_variances(motion: Motion) -> NDArray:
    """(F, S, 3) [m²] of the less certain end of each segment, along the world's axes."""
    tree, surfaces = motion.body.tree, motion.body.segment_ends()
    prior = np.concatenate([np.full(6, _FLAT_ROOT_SIGMA), np.minimum(tree.posture_std, _MAX_STD)])
    std = np.where(np.isfinite(motion.dof_std), motion.dof_std, prior)
    unbounded = ~np.isfinite(motion.joint_std).all(axis=-1, keepdims=True)
    own = np.where(unbounded, 0.0, np.square(motion.joint_std))
    for s, parent in enumerate(tree.parents):  # of an unbounded one what is known of the joint before it
        if parent >= 0:
            own[:, s] = np.where(unbounded[:, s], own[:, parent], own[:, s])
    for f in np.flatnonzero(unbounded.any(axis=(1, 2))):
        alone = np.where(np.isfinite(motion.dof_std[f]), 0.0, prior)
        unknown = _square_moves(motion, int(f)) @ np.square(alone)
        own[f] += np.where(unbounded[f], unknown[:, None] / 3.0, 0.0)
    out = own.copy()
    for s in range(len(tree.segments)):
        ends = own[:, [s, *np.flatnonzero(tree.parents == s)]]
        out[:, s] = np.take_along_axis(ends, ends.sum(axis=2).argmax(axis=1)[:, None, None], axis=1)[:, 0]
        if ends.shape[1] == 1 and s in surfaces:
            turns = np.flatnonzero(tree.owners == s)
            levers = np.linalg.norm(np.cross(tree.axes[turns], surfaces[s]), axis=-1)
            out[:, s] += (np.square(std[:, 6 + turns]) @ np.square(levers))[:, None] / 3.0
    return out


def contradicted(motion: Motion) -> NDArray:
    """(F, S) bool: segments whose points most views, for a tenth of a second, show more than 8 cm away from the fit."""
    shape = motion.segment_quality.shape
    seen, off = np.zeros(shape), np.zeros(shape)
    for r in motion.residuals.values():
        if r.unit != "px" or not r.of_points:
            continue
        owners, there = np.asarray(r.segments), np.isfinite(r.norms)
        fitted = np.where(there[..., None], r.measured - r.values, np.nan)
        joints = np.where(there[..., None], motion.joint_centres[:, owners], np.nan)
        far = r.norms > _MAX_CONTRADICTION_M * _pixels_per_metre(fitted, joints)[:, None]
        for s in np.unique(owners):
            count = there[:, owners == s].sum(axis=1)
            seen[:, s] += count > 0
            off[:, s] += 2 * (far & there)[:, owners == s].sum(axis=1) > np.maximum(count, 1)
    half = max(round(_WINDOW * motion.rate), 1)
    summed = [
        np.lib.stride_tricks.sliding_window_view(np.pad(x, ((half, half), (0, 0))), 2 * half + 1, axis=0).sum(axis=-1)
        for x in (off, seen)
    ]
    return np.asarray((2 * summed[0] > summed[1]) & (seen > 0))


def _pixels_per_metre(fitted: NDArray, joints: NDArray) -> NDArray:
    """(F,) about how large a metre at the body is in an image, from fitted points (F, K, 2) and their joints."""
    extents = []
    for x in (fitted, joints):
        count = np.isfinite(x[..., 0]).sum(axis=1)
        middle = np.nansum(x, axis=1) / np.maximum(count, 1)[:, None]
        extents.append(np.sqrt(np.nansum(np.square(x - middle[:, None]), axis=(1, 2))))
    return np.asarray(np.where(extents[1] > 0.0, extents[0] / np.maximum(extents[1], 1e-9), np.inf))


def _square_moves(motion: Motion, frame: int) -> NDArray:
    """(S, 6 + D) [m²] squared ways of the joint centres, by a unit of every degree of freedom."""
    tree, state = motion.body.tree, motion.state(frame)
    _, screws = tree.forward(state.T_world_root, state.angles)
    x = tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3] - state.T_world_root[:3, 3]
    lines = np.concatenate([np.eye(6), screws])  # (v, ω)
    out = np.square(lines[:, :3] + np.cross(lines[:, 3:], x[:, None])).sum(axis=-1)
    moved = np.zeros(out.shape, bool)
    for s, last in enumerate(tree.last_dof):
        moved[s, tree.chain[last, : tree.depth[last] + 1]] = True
    return np.where(moved, out, 0.0)


@dataclass(frozen=True)
class Moment:
    """A stretch of frames in which the result is doubtful.

    Parameters
    ----------
    start, stop : int, first frame and one after the last.
    worst : int, frame to look at.
    segments : names of those concerned; empty for the whole body.
    what : what is doubtful, one sentence each.
    causes : why, where the measurements tell.
    score : float, frames times the share of the body concerned, less where the doubt is smaller.
    """

    start: int
    stop: int
    worst: int
    segments: tuple[str, ...]
    what: tuple[str, ...]
    causes: tuple[str, ...]
    score: float


@dataclass(frozen=True)
class _Doubt:
    """One doubt: of one kind, about one segment ("" for the whole body)."""

    kind: str  # "unobserved", "against" or "wide"
    start: int
    stop: int
    worst: int
    score: float
    segment: str = ""
    amount: float = 0.0  # [cm]


def doubtful_moments(motion: Motion) -> tuple[Moment, ...]:
    """All doubtful moments, the worst first.

    Doubtful is a frame without anybody, and a segment that is `doubtful`. Where it is so in most frames, see
    `throughout_sentence`, those are left that views contradict, and those that are twice as uncertain as in the median.
    """
    found = [*_nobody(motion), *_doubts(motion)]
    with_causes = [replace(m, causes=causes(motion, m)) for m in _merged(motion.body, found)]
    return tuple(sorted(with_causes, key=lambda m: (-m.score, m.start)))


def doubt_sentence(motion: Motion, moments: Sequence[Moment]) -> str:
    """How many doubtful moments there are: "none", "1 (3 % of the frames)"."""
    if not moments:
        return "none" if motion.residuals else "none known, because the motion has no measurements"
    frames = np.zeros(len(motion), bool)
    for m in moments:
        frames[m.start : m.stop] = True
    return f"{len(moments)} ({100 * frames.mean():.0f}\u00a0% of the frames)"


def throughout_sentence(motion: Motion) -> str:
    """Segments with an end that is rather more than 5 cm off in most frames, with 2 σ; empty where there is none."""
    sigmas = uncertain_throughout(motion)
    if len(sigmas) == len(motion.body.tree.segments):
        return f"the whole body (±{200 * min(sigmas.values()):.0f} to {200 * max(sigmas.values()):.0f}\u00a0cm)"
    widest: dict[str, float] = {}
    for name, words in _spoken(motion.body, list(sigmas)).items():
        widest[words] = max(sigmas[name], widest.get(words, 0.0))
    each = [f"{name} (±{200 * sigma:.0f}\u00a0cm)" for name, sigma in widest.items()]
    return listed(each, 20) if each else ""


def when(motion: Motion, m: Moment) -> str:
    """Times, frames and segments of a moment: "1.20–1.43 s (frames 36–43): head"."""
    return f"{span(motion, m)} {place(motion, m)}"


def span(motion: Motion, m: Moment) -> str:
    """Times of a moment: "1.20–1.43 s"."""
    start, stop = motion.times[m.start], motion.times[m.stop - 1]
    return f"{start:.2f} s" if m.stop - m.start == 1 else f"{start:.2f}–{stop:.2f} s"


def place(motion: Motion, m: Moment) -> str:
    """Frames and segments of a moment: "(frames 36–43): head"."""
    frames = f"frame {m.start}" if m.stop - m.start == 1 else f"frames {m.start}–{m.stop - 1}"
    return f"({frames}): {spoken_segments(motion.body, m.segments)}"


def never_observed(motion: Motion) -> tuple[str, ...]:
    """Coordinates that nothing observes in most frames (their standard deviation is infinite)."""
    if not len(motion):
        return ()
    blind = np.mean(~np.isfinite(motion.dof_std), axis=0) > 0.5
    return tuple(name for name, is_blind in zip(motion.body.dof_names, blind) if is_blind)


def shared_by_prior(motion: Motion) -> dict[str, float]:
    """Coupled coordinates whose share of a bend the posture prior decides: median standard deviation [deg].

    Those of a coupling are reported if none of them is known to 5 degrees, beyond which errors may mislead a clinician
    (McGinley et al. 2009, Gait & Posture 29:360).
    """
    tree, out = motion.body.tree, dict[str, float]()
    for line in tree.couplings:
        own = np.flatnonzero(line)
        std = [s[np.isfinite(s)] for s in np.degrees(motion.dof_std[:, 6 + own]).T]
        middle = [float(np.median(s)) if len(s) else 0.0 for s in std]
        if min(middle) > 5.0:
            out |= {tree.coordinates[d]: m for d, m in zip(own, middle)}
    return out


def plain(segment: str) -> str:
    """A segment's name in words: hand_l becomes "left hand", index_distal_l "left index finger (distal)"."""
    stem, side = split_side(segment)
    name = stem.replace("_", " ").replace("upperarm", "upper arm")
    digit, _, bone = name.partition(" ")
    return f"{side} {f'{DIGITS[digit].lower()} ({bone})' if bone and digit in DIGITS else name}".strip()


def spoken_segments(body: Body, segments: Sequence[str], most: int = 4) -> str:
    """Segments in words, each once; several fingers of a hand together: "fingers of the left hand"."""
    return listed(dict.fromkeys(_spoken(body, segments).values()) or ["whole body"], most)


def _spoken(body: Body, segments: Sequence[str]) -> dict[str, str]:
    groups = finger_groups(body)
    hand = {s: name for name, own in groups.items() if len(set(own) & set(segments)) > 1 for s in own}
    return {s: f"fingers of the {plain(hand[s])}" if s in hand else plain(s) for s in segments}


def _runs(motion: Motion, flags: NDArray) -> list[tuple[int, int]]:
    return runs_of(flags, round(_GAP * motion.rate))


def _nobody(motion: Motion) -> Iterable[_Doubt]:
    for start, stop in runs_of(motion.quality <= 0):
        yield _Doubt("unobserved", start, stop, (start + stop) // 2, stop - start)


def _doubts(motion: Motion) -> Iterable[_Doubt]:
    if not motion.residuals:
        return
    share = 1 / len(motion.body.tree.segments)
    variances, against = end_variances(motion), contradicted(motion)
    sigma = np.sqrt(variances.sum(axis=-1))
    flags = doubtful(probably_far(variances), against) & (motion.quality > 0)[:, None] & ~unmarked(motion)
    unbounded = ~np.isfinite(motion.joint_std).all(axis=-1)
    often = 2 * flags.sum(axis=0) > len(motion)
    flags &= ~often | against | (sigma > 2 * np.median(sigma, axis=0))
    for s, name in enumerate(motion.body.tree.segments):
        for start, stop in _runs(motion, flags[:, s]):
            part = np.where(flags[start:stop, s], sigma[start:stop, s], 0.0)
            kind = "against" if 2 * against[start:stop, s].sum() > stop - start else "wide"
            amount = np.inf if unbounded[start:stop, s].any() else 200 * float(part.max())
            yield _Doubt(kind, start, stop, start + int(np.argmax(part)), share * (stop - start), name, amount)


def _merged(body: Body, found: Iterable[_Doubt]) -> list[Moment]:
    """What shares more than half of its time becomes one moment; of a segment or a hand, half of the shorter's time."""
    hand = {s: name for name, own in finger_groups(body).items() for s in own}
    groups: list[list[_Doubt]] = []
    spans: list[tuple[int, int]] = []
    for f in sorted(found, key=lambda f: -f.score):
        for k, (start, stop) in enumerate(spans):
            if f.start < stop and start < f.stop:
                first, last = min(f.start, start), max(f.stop, stop)
                same = any(hand.get(g.segment, g.segment) == hand.get(f.segment, f.segment) for g in groups[k])
                whole = min(f.stop - f.start, stop - start) if same else last - first
                if min(f.stop, stop) - max(f.start, start) > 0.5 * whole:
                    groups[k].append(f)
                    spans[k] = first, last
                    break
        else:
            groups.append([f])
            spans.append((f.start, f.stop))
    return [
        Moment(
            *span, group[0].worst, tuple(dict.fromkeys(g.segment for g in group if g.segment)),
            tuple(_sentences(body, group)), (), sum(g.score for g in group),
        )
        for group, span in zip(groups, spans)
    ]  # fmt: skip


def _sentences(body: Body, group: Sequence[_Doubt]) -> Iterable[str]:
    """Sentences on the findings of a moment; one sentence for all segments with the same finding."""
    for kind in dict.fromkeys(g.kind for g in group):
        same = [g for g in group if g.kind == kind]
        names = spoken_segments(body, [g.segment for g in same])
        most = max(g.amount for g in same)
        if kind == "unobserved":
            yield "The person was not observed; the body keeps its last pose."
        elif kind == "against":
            yield f"Most views show {names} more than 8 cm away from the body."
        else:
            far = f"up to ±{most:.0f} cm (2 σ)" if np.isfinite(most) else "unbounded in at least one direction"
            yield f"The position of {names} is uncertain: {far}."


def causes(motion: Motion, moment: Moment) -> tuple[str, ...]:
    """Causes of a doubtful moment, as far as its measurements show them."""
    pixels = {name: r for name, r in motion.residuals.items() if r.unit == "px"}
    frames = slice(moment.start, moment.stop)
    out, share_seen, left_out, seen_points = [], {}, {}, 0
    for name, r in pixels.items():
        points = _points_of(motion, r, moment.segments)
        seen = np.isfinite(r.values[frames][:, points]).all(axis=-1)
        share_seen[name] = float(seen.any(axis=1).mean()) if points.any() else 0.0
        left_out[name] = int(r.rejected[frames][:, points].sum())
        seen_points += int(seen.sum())
    seeing = [name for name, share in share_seen.items() if share >= 0.5]
    if pixels and len(seeing) < len(pixels) and len(seeing) <= 2:
        out.append(f"Only {listed(seeing)} saw it." if seeing else "No camera saw it for most of this time.")
    if seen_points and sum(left_out.values()) >= _MIN_OUTLIER_SHARE * seen_points:
        most = max(left_out, key=lambda name: left_out[name])
        share = 100 * sum(left_out.values()) / seen_points
        out.append(f"{share:.0f} % of its keypoints were rejected as outliers, most of them in {most}.")
    quality = motion.segment_quality[frames]
    more = "More evidence contradicts than supports {}"
    for text, of in (("No measurement supports {}", quality <= 0), (more, quality > 0)):
        gone = 2 * (of & motion.lost[frames]).sum(axis=0) > len(quality)
        if names := [n for n in moment.segments if gone[motion.body.tree.segments.index(n)]]:
            out.append(text.format(spoken_segments(motion.body, names)) + ".")
    swapped = [name for name, r in pixels.items() if np.any(np.asarray(r.swapped)[frames])]
    if swapped:
        out.append(f"The detector swapped left and right in {listed(swapped)} (corrected).")
    return tuple(out)


def _points_of(motion: Motion, r: Residuals, segments: Sequence[str]) -> NDArray:
    """(K,) bool: points of these segments, or of their neighbours where they have none; all for the whole body."""
    owners = np.asarray(r.segments)
    if not segments:
        return np.ones(len(owners), bool)
    tree = motion.body.tree
    chosen = np.isin(np.arange(len(tree.segments)), [tree.segments.index(s) for s in segments])
    if not np.isin(owners, np.flatnonzero(chosen)).any():
        parents = np.asarray(tree.parents)
        near = chosen.copy()
        near[parents[chosen & (parents >= 0)]] = True
        near |= (parents >= 0) & chosen[np.maximum(parents, 0)]
        chosen = near
    return np.isin(owners, np.flatnonzero(chosen))
