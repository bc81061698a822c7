"""Work on several cores: in order, no more at once than allowed, errors told."""

import threading
import time

import pytest

from kinefit._threads import ahead, cores, side_by_side, threads


@pytest.fixture(params=["1", "3"])
def allowed(request, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", request.param)
    monkeypatch.setattr("kinefit._threads.cores", lambda: 4)
    return int(request.param)


def test_threads_are_as_many_as_stated_and_no_more_than_cores(monkeypatch):
    for stated, wanted in (("1", 1), ("100000", cores()), ("", cores()), ("many", cores()), ("0", 1)):
        monkeypatch.setenv("NUMBA_NUM_THREADS", stated)
        assert threads() == wanted


def test_results_come_in_order_and_few_wait(allowed):
    lock, made, running, most = threading.Lock(), [], [0], [0]

    def things():
        for k in range(20):
            made.append(k)
            yield k

    def work(k):
        with lock:
            running[0] += 1
            most[0] = max(most[0], running[0])
        time.sleep(0.002 * (k % 3))
        with lock:
            running[0] -= 1
        return k * k

    for k, square in enumerate(side_by_side(work, things())):
        assert square == k * k
        assert len(made) <= k + allowed  # no thing is asked for long before it is needed
    assert k == 19 and most[0] <= allowed


def test_an_error_is_told_where_its_result_would_come(allowed):
    def work(k):
        if k == 2:
            raise ValueError("two")
        return k

    found = side_by_side(work, range(5))
    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(found)


def test_one_ahead_and_no_more(allowed):
    made = []

    def things():
        for k in range(5):
            made.append(k)
            yield k
        raise OSError("the end")

    found = ahead(things())
    for k in range(5):
        assert next(found) == k
        time.sleep(0.01)
        assert len(made) <= k + 2
    with pytest.raises(OSError, match="the end"):
        next(found)
    assert list(ahead([])) == []
