"""Clocks of videos from their sound: a clap, a step, a voice is recorded by all of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import KinefitError
from kinefit.readers.videos.video_files import open_container

_SAMPLE_RATE_HZ = 8000
_WINDOW = 40  # samples of one value of the envelope: 5 ms, in which sound goes 1.7 m
_ENVELOPE_RATE_HZ = _SAMPLE_RATE_HZ / _WINDOW
_QUIET_DB = -60.0  # of the loudest window: what is below is taken for silence
_MIN_OVERLAP_S = 2.0
_MAX_ONSET_DB = 10.0  # higher rises count as this one, so that two loud ones make no match
_MIN_SCORE = 12.0  # [standard deviations]: 300 pairs of other rooms, simulated, had 10 at most, 12 s of one room 18
_MIN_RATIO = 1.8  # to the next best shift; the same pairs 1.9 at most and 2.8, and a rhythm has many
_PEAK_S = 0.1  # about a shift, within which others are the same peak


def sound_offsets(paths: Sequence[Path]) -> NDArray:
    """Seconds to add to each video's times so that what was heard at once has one time.

    The onsets of loudness of two videos are correlated at all shifts; videos are tied along the pairs that correlate
    best (maximum spanning tree). Good to the distance of the microphones, 3 ms a metre.

    Parameters
    ----------
    paths : V video files

    Returns
    -------
    (V,) [s], of the first video 0; NaN of videos without sound, and of those whose sound fits no other's.
    """
    heard = [_onsets(path) for path in paths]
    ties: list[tuple[float, int, int, float]] = []
    for i, j in combinations(range(len(paths)), 2):
        if (match := _shift(heard[i], heard[j])) is not None:
            ties.append((match[0], i, j, match[1]))
    offsets = np.full(len(paths), np.nan)
    offsets[0] = 0.0
    while ready := [t for t in ties if np.isfinite(offsets[t[1]]) != np.isfinite(offsets[t[2]])]:
        _, i, j, late = max(ready)
        if np.isfinite(offsets[i]):
            offsets[j] = offsets[i] + late
        else:
            offsets[i] = offsets[j] - late
    return offsets


def _onsets(path: Path) -> NDArray:
    """(N,) rises of loudness [dB], from the first frame of the video on; none of a file without sound."""
    parts: list[NDArray] = []
    try:
        with open_container(path) as container:
            if not (container.streams.audio and container.streams.video):
                return np.zeros(0)
            first = next(p.pts * p.time_base for p in container.demux(container.streams.video[0]) if p.pts is not None)
        with open_container(path) as container:
            resampler = av.AudioResampler(format="flt", layout="mono", rate=_SAMPLE_RATE_HZ)
            start: float | None = None
            for frame in container.decode(audio=0):
                start = frame.time if start is None else start
                parts += [out.to_ndarray().ravel() for out in resampler.resample(frame)]
    except (KinefitError, av.FFmpegError, OSError, ValueError, StopIteration):  # sound is a help, no more
        return np.zeros(0)
    samples = np.concatenate([np.zeros(0), *parts])
    if start is None or not len(samples):
        return np.zeros(0)
    skip = round((float(first) - start) * _SAMPLE_RATE_HZ)  # what was heard before the first frame
    samples = samples[skip:] if skip >= 0 else np.concatenate([np.zeros(-skip), samples])
    power = np.square(samples[: len(samples) // _WINDOW * _WINDOW]).reshape(-1, _WINDOW).mean(axis=1)
    if not len(power) or not power.max() > 0.0:
        return np.zeros(0)
    loudness = 10.0 * np.log10(np.maximum(power / power.max(), 10.0 ** (_QUIET_DB / 10.0)))
    return np.clip(np.diff(loudness, prepend=loudness[0]), 0.0, _MAX_ONSET_DB)


def _shift(a: NDArray, b: NDArray) -> tuple[float, float] | None:
    """Score [standard deviations], and [s] to add to b's times; None where no shift stands out."""
    least = round(_MIN_OVERLAP_S * _ENVELOPE_RATE_HZ)
    if min(len(a), len(b)) < least or not (a.std() > 0.0 and b.std() > 0.0):
        return None
    a, b = ((x - x.mean()) / x.std() for x in (a, b))
    size = 1 << (len(a) + len(b)).bit_length()
    both = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
    shifts = np.arange(-(len(b) - least), len(a) - least + 1)
    overlap = np.minimum(len(a), len(b) + shifts) - np.maximum(0, shifts)
    score = both[shifts] / np.sqrt(overlap)
    best = int(np.argmax(score))
    near = round(_PEAK_S * _ENVELOPE_RATE_HZ)
    rest = np.concatenate([score[: max(best - near, 0)], score[best + near + 1 :], [0.0]])
    if score[best] < max(_MIN_SCORE, _MIN_RATIO * rest.max()):
        return None
    return float(score[best]), float(shifts[best]) / _ENVELOPE_RATE_HZ
