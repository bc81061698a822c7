"""Doubtful moments of a motion: when, which segments, how much, and why in plain words; the worst first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.pictures.drawing import OUTLIER_WEIGHT
from kinefit.findings import runs_of
from kinefit.motion import Motion, Residuals

DOUBTFUL = 0.5  # quality below which the measurements support less than half of the body
WIDE = 0.05  # [m] standard deviation of a joint centre: ±2 σ is as thick as a limb, which may then lie beside itself
_OFF = 4.0  # robust standard deviations that a frame's residual lies above the take's: by chance once in 30,000
_LEAST = 0.5  # [px, mm] of a residual that is told: less would be told as 0
_GAP = 0.1  # [s] stretches nearer than this are one to somebody who looks at the video
_MANY = 0.25  # share of outliers that is told as a cause; robust fits of good keypoints leave out less than a tenth


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
    """One doubt: of one kind, about one segment ("" for the whole body) or one sensor (name, unit, usual residual)."""

    kind: str  # "nobody", "weak", "unseen", "against", "wide" or "off"
    start: int
    stop: int
    worst: int
    score: float
    segment: str = ""
    amount: float = 0.0  # [%], [cm], [px] or [mm]
    sensor: tuple[str, str, float] = ("", "", 0.0)


def doubtful_moments(motion: Motion) -> tuple[Moment, ...]:
    """All doubtful moments, the worst first.

    Doubtful is a frame of low quality or without anybody, a segment that is lost, a joint centre with
    a wide error bar that is usually narrower, and a frame that fits much worse than the others.
    """
    found = [*_whole_body(motion), *_lost(motion), *_wide(motion), *_off(motion)]
    told = [replace(m, causes=causes(motion, m)) for m in _merged(found)]
    return tuple(sorted(told, key=lambda m: (-m.score, m.start)))


def doubt_sentence(motion: Motion, moments: Sequence[Moment]) -> str:
    """How many doubtful moments there are: "none", "1 (3 % of the frames)"."""
    if not moments:
        return "none" if motion.residuals else "none known, as the motion comes without measurements"
    frames = np.zeros(len(motion), bool)
    for m in moments:
        frames[m.start : m.stop] = True
    return f"{len(moments)} ({100 * frames.mean():.0f}\u00a0% of the frames)"


def when(motion: Motion, m: Moment) -> str:
    """Times, frames and segments of a moment: "1.20–1.43 s (frames 36–43): head"."""
    return f"{span(motion, m)} {place(m)}"


def span(motion: Motion, m: Moment) -> str:
    """Times of a moment: "1.20–1.43 s"."""
    start, stop = motion.times[m.start], motion.times[m.stop - 1]
    return f"{start:.2f} s" if m.stop - m.start == 1 else f"{start:.2f}–{stop:.2f} s"


def place(m: Moment) -> str:
    """Frames and segments of a moment: "(frames 36–43): head"."""
    frames = f"frame {m.start}" if m.stop - m.start == 1 else f"frames {m.start}–{m.stop - 1}"
    return f"({frames}): {listed([plain(s) for s in m.segments]) or 'whole body'}"


def never_observed(motion: Motion) -> tuple[str, ...]:
    """Coordinates that nothing observes in most frames (their standard deviation is infinite)."""
    if not len(motion):
        return ()
    blind = np.mean(~np.isfinite(motion.dof_std), axis=0) > 0.5
    return tuple(name for name, is_blind in zip(motion.body.dof_names, blind) if is_blind)


def shared_by_prior(motion: Motion) -> dict[str, float]:
    """Coupled coordinates whose share of a bend the posture prior tells, with their median standard deviation [deg].

    Those of a coupling are told where none of them is known to 5 degrees, beyond which errors may mislead a clinician
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
    """A segment's name in words: hand_l becomes "left hand"."""
    side = {"_l": "left ", "_r": "right "}.get(segment[-2:], "")
    return (side + (segment[:-2] if side else segment)).replace("_", " ").replace("upperarm", "upper arm")


def listed(names: Sequence[str], most: int = 4) -> str:
    """Names as "a, b and c"; those beyond `most` are counted."""
    names = list(names)
    if len(names) > most + 1:
        names = [*names[:most], f"{len(names) - most} more"]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def frame_residuals(residuals: Residuals) -> NDArray:
    """(F,) median length of a sensor's residuals in each frame, NaN where it saw nothing."""
    norms = residuals.norms
    out = np.full(len(norms), np.nan)
    seen = np.isfinite(norms).any(axis=1)
    out[seen] = np.nanmedian(norms[seen], axis=1)
    return out


def _runs(motion: Motion, flags: NDArray) -> list[tuple[int, int]]:
    return runs_of(flags, round(_GAP * motion.rate))


def _whole_body(motion: Motion) -> Iterable[_Doubt]:
    nobody = motion.quality <= 0
    for start, stop in runs_of(nobody):
        yield _Doubt("nobody", start, stop, (start + stop) // 2, stop - start)
    for start, stop in _runs(motion, (motion.quality < DOUBTFUL) & ~nobody):
        q = np.where(nobody[start:stop], 1.0, motion.quality[start:stop])
        yield _Doubt("weak", start, stop, start + int(np.argmin(q)), float(np.sum(1 - q)), amount=100 * float(q.min()))


def _lost(motion: Motion) -> Iterable[_Doubt]:
    share = 1 / len(motion.body.tree.segments)
    gone = motion.lost & (motion.quality > 0)[:, None]
    for kind, of in (("unseen", motion.segment_quality <= 0), ("against", motion.segment_quality > 0)):
        for s, name in enumerate(motion.body.tree.segments):
            for start, stop in _runs(motion, gone[:, s] & of[:, s]):
                yield _Doubt(kind, start, stop, (start + stop) // 2, share * (stop - start), name)


def _wide(motion: Motion) -> Iterable[_Doubt]:
    share = 0.5 / len(motion.body.tree.segments)
    std = np.linalg.norm(motion.joint_std, axis=-1)
    usual = np.median(std, axis=0) if len(std) else np.zeros(std.shape[1])
    doubtful = (std > WIDE) & (std > 2 * usual) & ~motion.lost & (motion.quality > 0)[:, None]
    for s, name in enumerate(motion.body.tree.segments):
        for start, stop in _runs(motion, doubtful[:, s]):
            part = np.where(doubtful[start:stop, s], std[start:stop, s], 0.0)
            worst = start + int(np.argmax(part))
            yield _Doubt("wide", start, stop, worst, share * (stop - start), name, amount=200 * float(part.max()))


def _off(motion: Motion) -> Iterable[_Doubt]:
    share = 0.5 / max(len(motion.residuals), 1)
    for name, r in motion.residuals.items():
        level = frame_residuals(r) * (1 if r.unit == "px" else 1000)
        seen = np.isfinite(level)
        if not seen.any():
            continue
        usual = float(np.median(level[seen]))
        spread = 1.4826 * float(np.median(np.abs(level[seen] - usual)))
        bad = seen & (level > usual + _OFF * spread) & (level > max(1.5 * usual, _LEAST))
        for start, stop in _runs(motion, bad):
            part = np.where(bad[start:stop], level[start:stop], 0.0)
            excess = np.minimum(part[part > 0] / max(usual, 1e-9) - 1, 3.0)
            unit = "px" if r.unit == "px" else "mm"
            worst, sensor = start + int(np.argmax(part)), (name, unit, usual)
            score, most = share * float(excess.sum()), float(part.max())
            yield _Doubt("off", start, stop, worst, score, amount=most, sensor=sensor)


def _merged(found: Iterable[_Doubt]) -> list[Moment]:
    """What shares more than half of its time becomes one moment; of the same segment, half of the shorter's time."""
    groups: list[list[_Doubt]] = []
    spans: list[tuple[int, int]] = []
    for f in sorted(found, key=lambda f: -f.score):
        for k, (start, stop) in enumerate(spans):
            if f.start < stop and start < f.stop:
                first, last = min(f.start, start), max(f.stop, stop)
                same = any(g.segment == f.segment for g in groups[k])
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
            tuple(_sentences(group)), (), sum(g.score for g in group),
        )
        for group, span in zip(groups, spans)
    ]  # fmt: skip


def _sentences(group: Sequence[_Doubt]) -> Iterable[str]:
    """What a moment's findings say; what is the same of several segments is said once, of all."""
    for kind in dict.fromkeys(g.kind for g in group):
        same = [g for g in group if g.kind == kind]
        names = listed(list(dict.fromkeys(plain(g.segment) for g in same)))
        most = max(g.amount for g in same)
        if kind == "nobody":
            yield "Nothing of the person was seen; the body stays where it was."
        elif kind == "weak":
            yield f"The measurements support only {min(g.amount for g in same):.0f} % of the body at worst."
        elif kind == "unseen":
            yield f"No measurement supports {names}: the pose follows from what is next to it and from earlier frames."
        elif kind == "against":
            yield f"More of what was measured speaks against where {names} is than for it."
        elif kind == "wide":
            far = f"up to ±{most:.0f} cm (2 σ)" if np.isfinite(most) else "in some direction nothing bounds it"
            yield f"The place of {names} is uncertain: {far}."
        else:
            for sensor, unit, usual in dict.fromkeys(g.sensor for g in same):
                most = max(g.amount for g in same if g.sensor[0] == sensor)
                yield f"The body lies {most:.0f} {unit} beside what {sensor} saw (its median is {usual:.0f})."


def causes(motion: Motion, moment: Moment) -> tuple[str, ...]:
    """What the measurements of a moment tell about why it is doubtful."""
    pixels = {name: r for name, r in motion.residuals.items() if r.unit == "px"}
    frames = slice(moment.start, moment.stop)
    out, share_seen, left_out, seen_points = [], {}, {}, 0
    for name, r in pixels.items():
        points = _points_of(motion, r, moment.segments)
        seen = np.isfinite(r.values[frames][:, points]).all(axis=-1)
        share_seen[name] = float(seen.any(axis=1).mean()) if points.any() else 0.0
        left_out[name] = int((seen & (np.asarray(r.weights)[frames][:, points] < OUTLIER_WEIGHT)).sum())
        seen_points += int(seen.sum())
    seeing = [name for name, share in share_seen.items() if share >= 0.5]
    if pixels and len(seeing) < len(pixels) and len(seeing) <= 2:
        out.append(f"Only {listed(seeing)} saw it." if seeing else "No camera saw it for most of this time.")
    if seen_points and sum(left_out.values()) >= _MANY * seen_points:
        most = max(left_out, key=lambda name: left_out[name])
        share = 100 * sum(left_out.values()) / seen_points
        out.append(f"{share:.0f} % of its keypoints were left out as outliers, most of them in {most}.")
    swapped = [name for name, r in pixels.items() if np.any(np.asarray(r.swapped)[frames])]
    if swapped:
        out.append(f"The detector took left for right in {listed(swapped)} (put right).")
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
