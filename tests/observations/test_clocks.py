"""Keypoints of frames at any times are put onto even steps: against a moving point that is known everywhere."""

import re

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.observations import Keypoints
from kinefit.observations.clocks import frames_by_name, is_even, nominal_rate, on_steps, steps_of, unevenness

RATE = 60.0
SPEED, SWAY, TURN = 400.0, 30.0, 6.0  # [px/s], [px], [rad/s]


def truth(times, k=0.0):
    """(N, 2) [px] of a point that drifts and sways."""
    sway = SWAY * np.stack([np.sin(TURN * times), np.cos(TURN * times)], -1)
    return sway + np.stack([SPEED * times, np.full(len(times), 200.0)], -1) + np.array([10, 50]) * k


def seen(times, people=1, rate=RATE):
    points = np.stack([[truth(times, k) + 900 * p for k in range(4)] for p in range(people)])  # (P, K, F, 2)
    points = points.transpose(2, 0, 1, 3)
    lifted = np.concatenate([points, points[..., :1]], axis=-1) / 1000
    return Keypoints("cam", "own", tuple("abcd"), rate, points, np.full(points.shape[:3], 0.8), lifted=lifted)


ALL = np.arange(120) / RATE
DROPPED = np.delete(ALL, np.arange(41, 80, 2))
JITTER = ALL + np.random.default_rng(1).uniform(-0.3, 0.3, len(ALL)) / RATE


@pytest.mark.parametrize("times", [DROPPED, JITTER, ALL[::2], np.arange(200) / 97.0 + 0.013], ids=["d", "j", "h", "o"])
def test_a_moving_point_is_interpolated_within_the_error_of_a_chord(times):
    frames = steps_of(times, RATE)
    found = on_steps(seen(times), times, RATE, frames)
    np.testing.assert_allclose(found.times, np.arange(*frames) / RATE)
    chord = SWAY * TURN**2 * np.diff(times).max() ** 2 / 8.0  # acceleration times distance squared over 8
    inside = (found.times >= times[0]) & (found.times <= times[-1])
    for k in range(4):
        error = np.linalg.norm(found.points[inside, 0, k] - truth(found.times[inside], k), axis=-1)
        assert error.max() <= 1.5 * chord + _shift() < 3.0
    assert found.rate == RATE and np.all(found.confidence[inside] == pytest.approx(0.8))
    np.testing.assert_allclose(found.lifted[inside, ..., :2], found.points[inside] / 1000)


def _shift():
    return 0.02 * SPEED * 1.5 / RATE  # of a frame that counts at a step as it is


def test_frames_at_steps_stay_as_they_are():
    found = on_steps(seen(DROPPED), DROPPED, RATE, (0, 120))
    np.testing.assert_array_equal(found.points[:41], seen(DROPPED).points[:41])


def test_a_gap_is_not_bridged():
    times = np.delete(ALL, slice(50, 52))  # two frames are lacking
    found = on_steps(seen(times), times, RATE, (0, 120))
    assert np.flatnonzero(np.isnan(found.points).all((1, 2, 3))).tolist() == [50, 51]
    assert np.all(found.confidence[[50, 51]] == 0.0) and np.isnan(found.lifted[[50, 51]]).all()


def test_a_point_that_one_of_two_frames_saw_is_unseen_between_them():
    record = seen(ALL[::2])
    points = np.array(record.points)
    points[10, 0, 2] = np.nan
    found = on_steps(Keypoints("cam", "own", tuple("abcd"), 30.0, points, record.confidence), ALL[::2], RATE, (0, 119))
    assert np.flatnonzero(np.isnan(found.points[:, 0, 2, 0])).tolist() == [19, 20, 21]
    assert np.isfinite(found.points[:, 0, [0, 1, 3]]).all() and np.all(found.confidence[19:22, 0, 2] == 0.0)


def test_people_whose_order_changes_are_the_nearest_ones():
    record = seen(ALL[::2], people=2)
    points = np.array(record.points)
    points[1::2] = points[1::2, ::-1]
    found = on_steps(Keypoints("cam", "own", tuple("abcd"), 30.0, points, record.confidence), ALL[::2], RATE, (0, 119))
    x = np.sort(found.points[:, :, 0, 0], axis=1)
    np.testing.assert_allclose(x, truth(found.times)[:, :1] + [0, 900], atol=0.5)


def test_somebody_else_is_not_the_same_person():
    record = seen(ALL[::2])
    points = np.array(record.points)
    points[30:] += 700.0
    found = on_steps(Keypoints("cam", "own", tuple("abcd"), 30.0, points, record.confidence), ALL[::2], RATE, (0, 119))
    assert np.flatnonzero(np.isnan(found.points[:, 0, 0, 0])).tolist() == [59]


def test_rates_and_what_is_said_of_them():
    assert is_even(ALL + 5.0, RATE) and not is_even(DROPPED, RATE) and unevenness(ALL, RATE) == ""
    assert is_even(ALL[:0], RATE) and is_even(ALL[:1], RATE) and unevenness(ALL[:0], RATE) == ""
    milliseconds = np.round(np.arange(500) / 240, 3)
    assert nominal_rate(milliseconds) == pytest.approx(240, rel=1e-3) and is_even(milliseconds, 240.0)
    assert nominal_rate(DROPPED) == pytest.approx(60)
    assert nominal_rate(np.array([0.0, 0.1, 0.4])) == pytest.approx(1 / 0.3)  # two distances with nothing between
    assert unevenness(DROPPED, RATE) == "variable frame rate, 60 Hz nominal, 20 frames lacking between 0.667 and 1.33 s"
    assert steps_of(ALL[::2] + 0.1, RATE) == (6, 125) and steps_of(ALL + 0.1, RATE) == (6, 126)
    assert steps_of(np.array([0.5]), RATE) == (30, 31)
    assert len(on_steps(seen(ALL[:1]), ALL[:1], RATE, (0, 2))) == 2


@pytest.mark.parametrize(("names", "times", "said"), [
    (["a_1.png", "a_2.png", "a_3.png"], [0, 1 / 30, 2 / 30], ""),
    (["0.png", "3.png", "6.png"], [0, 0.1, 0.2], "step by 3.*rate = 90"),
    (["0003_mask.png", "0006_mask.png", "0012_mask.png"], [0, 0.1, 0.3], "step by 3"),
    (["f8.png", "f9.png", "f12.png"], [0, 1 / 30, 4 / 30], "2 numbers are missing"),
    (["d00_cam2.png", "d05_cam2.png"], [0, 5 / 30], "step by 5"),  # the number that differs is the frame's
    (["1305031102.160407.png", "1305031102.260407.png"], [0, 0.1], "are taken as their times"),  # TUM
    (["1403636579763555584.png", "1403636579813555584.png"], [0, 0.05], "times"),  # EuRoC [ns]
    (["d_1714566605123.png", "d_1714566605223.png"], [0, 0.1], "times"),
    (["2024-05-01_12-30-05-900.png", "2024-05-01_12-30-06-000.png"], [0, 0.1], "times"),
    (["20240501123005950.png", "20240501123006000.png"], [0, 0.05], "times"),
    (["0.0333.png", "0.0667.png"], [0, 0.0334], "times"),
    (["d33.png", "d67.png", "d100.png", "d133.png"], [0, 0.034, 0.067, 0.1], "times in 0.001 s.*look the same"),
    (["shot1.0001.png", "shot1.0002.png"], [0, 1 / 30], ""),  # a frame's number, not a decimal
    (["d-82823944", "d-1028894671"], [0, 1 / 30], "not used.*time_unit"),
    (["start.png", "end.png"], [0, 1 / 30], ""),
])  # fmt: skip
def test_numbers_in_names_are_frames_or_times(names, times, said):
    found, text = frames_by_name(names).on_clock(30.0)
    np.testing.assert_allclose(found, times, atol=1e-6)
    assert re.search(said, text) and bool(said) == bool(text)


@pytest.mark.parametrize("names", [
    ["0001.png", "0001_overlay.png", "0002.png"], ["cam1_01.png", "cam1_02.png", "cam2_01.png"],
])  # fmt: skip
def test_two_files_with_one_number_are_named(names):
    with pytest.raises(ObservationError, match="two masks with one number: .*01.* and .*01") as told:
        frames_by_name(names, "masks")
    assert "pattern" in told.value.remedy
