"""Clocks of videos from their sound."""

import av
import numpy as np
import pytest

from kinefit.readers.videos.sound import sound_offsets

LENGTH = 40.0  # [s] of what happened


def room(seed):
    """(N,) at 48 kHz: a steady noise, and steps, claps and words at random times."""
    random = np.random.default_rng(seed)
    sound = 0.002 * random.normal(size=round(48000 * LENGTH))
    for at in np.sort(random.uniform(0.0, LENGTH - 0.5, 60)):
        n = round(48000 * random.uniform(0.02, 0.3))
        burst = random.uniform(0.05, 0.5) * random.normal(size=n) * np.exp(-6.0 * np.arange(n) / n)
        sound[round(48000 * at) :][:n] += burst
    return sound


def write(path, sound, begin, seconds, *, gain=1.0, noise=0.0, rate=48000, seed=0):
    """A video of so many seconds that began `begin` seconds into the sound; without sound where it is None."""
    with av.open(str(path), "w") as target:
        video = target.add_stream("mpeg4", rate=30)
        video.width, video.height, video.pix_fmt = 32, 32, "yuv420p"
        audio = target.add_stream("aac", rate=rate) if sound is not None else None
        for _ in range(round(30 * seconds)):
            frame = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
            target.mux(video.encode(frame))
        target.mux(video.encode())
        if audio is not None:
            part = gain * sound[round(48000 * begin) : round(48000 * (begin + seconds))]
            part = part[:: 48000 // rate] if rate < 48000 else part
            part = part + noise * np.random.default_rng(seed).normal(size=len(part))
            for k in range(0, len(part) - 1023, 1024):
                frame = av.AudioFrame.from_ndarray(part[None, k : k + 1024].astype(np.float32), "fltp", "mono")
                frame.sample_rate, frame.pts = rate, k
                target.mux(audio.encode(frame))
            target.mux(audio.encode())
    return path


def test_videos_that_heard_the_same_are_set_by_it(tmp_path):
    sound = room(0)
    paths = [
        write(tmp_path / "a.mp4", sound, 10.0, 15.0),
        write(tmp_path / "b.mp4", sound, 17.3, 20.0, gain=0.2, noise=0.002, seed=1),
        write(tmp_path / "c.mp4", sound, 2.15, 12.0, gain=3.0, rate=24000, seed=2),
    ]
    assert sound_offsets(paths) == pytest.approx([0.0, 7.3, -7.85], abs=0.03)


def test_silence_other_rooms_and_other_files_say_nothing(tmp_path):
    paths = [write(tmp_path / f"{k}.mp4", room(k), 5.0, 12.0) for k in range(4)]
    paths.append(write(tmp_path / "mute.mp4", None, 0.0, 3.0))
    paths.append(write(tmp_path / "zero.mp4", np.zeros(round(48000 * LENGTH)), 0.0, 5.0))
    (tmp_path / "no.mp4").write_text("not a video")
    offsets = sound_offsets([*paths, tmp_path / "no.mp4"])
    assert offsets[0] == 0.0 and np.isnan(offsets[1:]).all()


def test_a_beat_has_no_one_shift(tmp_path):
    beat = np.zeros(round(48000 * LENGTH))
    for k in range(int(LENGTH * 2)):
        beat[24000 * k : 24000 * k + 2400] = np.random.default_rng(0).normal(size=2400)
    paths = [write(tmp_path / "a.mp4", beat, 3.0, 12.0), write(tmp_path / "b.mp4", beat, 4.25, 12.0)]
    assert np.isnan(sound_offsets(paths)[1])
