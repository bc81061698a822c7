"""The clock of marker files in a take."""

import numpy as np
import pytest

from kinefit import Markers
from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.exporters import write_markers
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations


def write_take(path, text, **clock):
    """A take of a squat's markers, one millimetre further along x in each frame."""
    x = np.ones((30, 4, 3)) + 0.001 * np.arange(30)[:, None, None]
    names = load_body("humanoid").landmarks.names[:4]
    write_markers(Markers(names, 30.0, x, up="y", **clock), path.parent / "a.trc", unit="m")
    path.write_text(text)
    return read_take(path)


def seen_at(take):
    """Times [s] of the take's steps, and which frame of the markers is seen at each."""
    recording, _ = recording_of(take, load_observations(take), load_body("humanoid"))
    frames = [[f for f in recording.steps(i) if f.sensor == "markers"] for i in range(len(recording))]
    return recording.times, [round(1000 * (f[0].positions[0, 0] - 1)) if f else None for f in frames]


def test_a_take_of_markers_alone_has_their_clock(tmp_path):
    take = write_take(tmp_path / "take.toml", '[[markers]]\nfile = "a.trc"\n', first_time=12.51)
    times, frames = seen_at(take)
    np.testing.assert_allclose(times, 12.51 + np.arange(30) / 30)
    assert frames == list(range(30)) and not load_observations(take).notes
    text = '[take]\nframes = [6, 20]\n[[markers]]\nfile = "a.trc"\n'
    times, frames = seen_at(write_take(tmp_path / "take.toml", text, first_time=12.51))
    np.testing.assert_allclose(times, 12.51 + np.arange(6, 20) / 30)
    assert frames == list(range(6, 20))


def test_two_files_of_one_clock_are_in_step(tmp_path):
    write_take(tmp_path / "take.toml", '[[markers]]\nfile = "a.trc"\n', first_time=12.0)
    (tmp_path / "a.trc").rename(tmp_path / "b.trc")
    text = '[[markers]]\nfile = "a.trc"\n[[markers]]\nfile = "b.trc"\n'
    seen = load_observations(write_take(tmp_path / "take.toml", text, first_time=12.5))
    assert (seen.first_time, seen.frames) == (12.0, (0, 45))


def test_with_other_sensors_the_files_times_are_the_takes(tmp_path, copy_take):
    take = copy_take(tmp_path)
    whole = take.read_text() + '\n[[markers]]\nfile = "a.trc"\ntime_offset = -12.0\n'
    times, frames = seen_at(write_take(take, whole, first_time=12.5))
    first = frames.index(0)
    assert times[0] == 0.0 and times[first] == pytest.approx(0.5) and frames[first - 1] is None
    (note,) = (n for n in load_observations(read_take(take)).notes if "a.trc" in n)
    assert note == "[[markers]] 1: a.trc begins at 0.5 s of the take, by its own clock and time_offset"
    apart = write_take(take, whole.replace("time_offset = -12.0\n", ""), first_time=12.5)
    with pytest.raises(ObservationError, match="from 12.5 to 13.5 s.*add -12.5 s to its time_offset") as caught:
        load_observations(apart)
    assert caught.value.place == "[[markers]] 1"
