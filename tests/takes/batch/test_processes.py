"""Jobs on processes: every job once, errors and deaths told, nobody else harmed."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.takes.batch import jobs

from kinefit.takes.batch.processes import Failure, run_here


def results(do, given, **more):
    return dict(run_here(do, given, **{"workers": 2, "retries": 0} | more))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_job_has_its_result(workers):
    assert results(jobs.square, list(range(7)), workers=workers) == {k: k * k for k in range(7)}
    assert results(jobs.square, []) == {}


def test_results_come_as_jobs_end():
    order = [number for number, _ in run_here(jobs.slow_first, [0, 1, 2], workers=2, retries=0)]
    assert order[-1] == 0 and sorted(order) == [0, 1, 2]


def test_an_error_is_told_and_stops_no_other():
    found = results(jobs.odd_is_wrong, [0, 1, 2], retries=1)
    assert found[0] == 0 and found[2] == 2
    assert isinstance(found[1], Failure) and found[1] == "RuntimeError: 1 is odd"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_worker_that_dies_is_tried_again_then_told(tmp_path):
    assert results(jobs.dies_once, [str(tmp_path / "mark")], retries=1) == {0: "alive"}
    found = results(jobs.killed, [0, 1, 2, 3], retries=2)
    assert [found[k] for k in (0, 2, 3)] == [0, 2, 3]
    assert isinstance(found[1], Failure) and found[1] == "the worker process died (SIGKILL)"


def test_workers_have_one_thread_and_the_environment_stays(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    found = results(jobs.threads, [0, 1], workers=1)
    assert {threads for threads, _ in found.values()} == {"1"} and len({pid for _, pid in found.values()}) == 1
    assert "OMP_NUM_THREADS" not in os.environ


_PARENT = """
from tests.takes.batch.jobs import slow_first
import os, time
from kinefit.takes.batch.processes import run_here
from tests.takes.batch import test_processes as t
if __name__ == "__main__":
    for _ in run_here(t.write_and_wait, [{path!r}], workers=1, retries=0):
        pass
"""


def write_and_wait(path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc whether a process lives")
def test_no_worker_outlives_the_process_that_was_killed(tmp_path):
    script, told = tmp_path / "parent.py", tmp_path / "pid"
    script.write_text(_PARENT.format(path=str(told)))
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    parent = subprocess.Popen([sys.executable, str(script)], env=environment)
    began = time.monotonic()
    while not (told.exists() and told.read_text()) and time.monotonic() - began < 30:
        time.sleep(0.02)
    parent.kill()
    parent.wait()
    worker, began = Path(f"/proc/{told.read_text()}/stat"), time.monotonic()
    while worker.exists() and worker.read_text().split()[2] != "Z" and time.monotonic() - began < 10:
        time.sleep(0.02)
    assert time.monotonic() - began < 10


def test_reports_of_progress_are_no_results():
    assert results(jobs.reports, [4, 5]) == {0: 4, 1: 5}


def test_a_job_without_progress_is_stopped_and_not_tried_again():
    found = results(jobs.hangs, [0, 1, 2], workers=1, retries=2, limit=6.0)
    assert found[0] == 0 and found[2] == 2
    assert isinstance(found[1], Failure) and found[1] == (
        "stopped after 0.1 min without progress; the limit is --time-limit")
