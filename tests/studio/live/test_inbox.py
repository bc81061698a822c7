"""The newest frame of each sensor alone waits; what it replaces is counted."""

import threading
import time

import pytest

from kinefit.errors import ObservationError
from kinefit.studio.live.cameras import Arrived, Inbox


def frame(sensor, number):
    return Arrived(sensor, float(number), time.monotonic(), number)


def test_what_nobody_took_is_dropped_and_counted():
    inbox = Inbox(["a"], patience=0.0)
    for k in range(5):
        assert inbox.put(frame("a", k))
    assert [one.seen for one in inbox.take(1.0)] == [4]
    assert inbox.dropped == {"a": 4} and inbox.came == {"a": 5}


def test_frames_of_one_step_come_together():
    inbox = Inbox(["a", "b"], patience=5.0)
    inbox.put(frame("a", 0))
    threading.Timer(0.05, lambda: inbox.put(frame("b", 0))).start()
    assert {one.sensor for one in inbox.take(5.0)} == {"a", "b"}


def test_nobody_waits_longer_than_patience_says():
    inbox = Inbox(["a", "b"], patience=0.02)
    inbox.put(frame("a", 0))
    assert [one.sensor for one in inbox.take(5.0)] == ["a"]


def test_a_patient_source_loses_nothing():
    inbox = Inbox(["a"], patience=10.0)

    def bring():
        for k in range(50):
            inbox.put(frame("a", k), wait=True)
        inbox.end("a")

    thread = threading.Thread(target=bring)
    thread.start()
    seen = []
    while not inbox.over:
        seen += [one.seen for one in inbox.take(1.0)]
    thread.join()
    assert seen == list(range(50)) and inbox.dropped == {"a": 0}


def test_one_that_waits_goes_on_when_all_is_over():
    inbox = Inbox(["a"], patience=0.0)
    inbox.put(frame("a", 0))
    answers = []
    thread = threading.Thread(target=lambda: answers.append(inbox.put(frame("a", 1), wait=True)))
    thread.start()
    inbox.close()
    thread.join(timeout=5.0)
    assert answers == [False] and inbox.over


def test_an_error_of_a_source_reaches_who_takes():
    inbox = Inbox(["a"], patience=0.0)
    inbox.end("a", ObservationError("no image"))
    with pytest.raises(ObservationError, match="no image"):
        inbox.take(1.0)


def test_a_silent_sensor_is_told_and_not_waited_for(monkeypatch):
    monkeypatch.setattr("kinefit.studio.live.cameras.SILENT_AFTER_S", 0.05)
    inbox = Inbox(["a", "b"], patience=0.02)
    inbox.put(frame("a", 0))
    inbox.take(1.0)
    time.sleep(0.1)
    inbox.put(frame("a", 1))
    assert inbox.silent() == ["b"]
    inbox.put(frame("b", 1))
    assert inbox.silent() == []
