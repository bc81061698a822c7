"""Jobs on a Dask cluster; skipped where it is not installed."""

import os
import signal
import sys

import pytest
from tests.takes.batch import jobs
from tests.takes.batch.test_many import CHOICES, contents, drawn_sessions, sessions

from kinefit import track_takes
from kinefit.errors import ExportError
from kinefit.takes.batch.processes import Failure, run_there
from kinefit.takes.batch.summary import RECORD

__all__ = ["drawn_sessions", "sessions"]


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ExportError, match=r"kinefit\[cluster\]"):
        next(run_there(jobs.square, [1], address="tcp://127.0.0.1:1", retries=0))


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0", protocol="tcp://"
    ) as made:
        yield made.scheduler_address


def results(do, given, address, **more):
    return dict(run_there(do, given, address=address, **{"retries": 0} | more))


def test_every_job_has_its_result(cluster):
    assert results(jobs.square, list(range(20)), cluster) == {k: k * k for k in range(20)}
    assert results(jobs.square, [3, 3], cluster) == {0: 9, 1: 9}


def test_an_error_is_told_and_stops_no_other(cluster):
    found = results(jobs.odd_is_wrong, [0, 1, 2], cluster, retries=1)
    assert found == {0: 0, 1: "RuntimeError: 1 is odd", 2: 2} and isinstance(found[1], Failure)


def test_workers_with_another_kinefit_are_refused(cluster, monkeypatch):
    from kinefit.takes.batch import processes as module

    monkeypatch.setattr(module, "code_digest", lambda calls=[]: calls.append(1) or len(calls))
    with pytest.raises(ExportError, match="another version of kinefit"):
        results(jobs.square, [1], cluster)


def test_no_scheduler_is_told(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("kinefit.takes.batch.processes._CONNECT_TIMEOUT", 0.3)
    with pytest.raises(ExportError, match="no Dask scheduler answers"):
        results(jobs.square, [1], "tcp://127.0.0.1:9")
    with pytest.raises(ExportError, match="no Dask scheduler answers"):
        results(jobs.square, [1], "nonsense://x")


@pytest.fixture
def processes():
    """A cluster of two worker processes, each with a nanny that starts it anew."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", protocol="tcp://"
    ) as made:
        yield made


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.filterwarnings("default::ResourceWarning")
def test_a_worker_that_dies_is_tried_again_then_told(processes, tmp_path):
    address = processes.scheduler_address
    assert results(jobs.dies_once, [str(tmp_path / "mark")], address, retries=1) == {0: "alive"}
    found = results(jobs.killed, [0, 1, 2, 3], address, retries=1)
    assert [found[k] for k in (0, 2, 3)] == [0, 2, 3]
    assert isinstance(found[1], Failure) and found[1] == "the worker died in every attempt"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.filterwarnings("default::ResourceWarning")
def test_jobs_on_the_same_worker_as_one_that_kills_it_are_not_blamed():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=True, dashboard_address=":0", protocol="tcp://"
    ) as made:
        found = results(jobs.killed_later, [0, 1], made.scheduler_address)
    assert found == {0: 0, 1: "the worker died in every attempt"}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.filterwarnings("default::ResourceWarning")
def test_a_study_goes_on_where_a_worker_was_killed(processes, sessions, tmp_path):
    from distributed import Client

    pattern, out, address = f"{sessions}/**/take.toml", tmp_path / "out", processes.scheduler_address
    with Client(address, set_as_default=False) as client:
        pids = list(client.run(os.getpid).values())

    def kill(done, count, rows):
        if done == 1:  # both workers, one of them at work on another take
            for pid in pids:
                os.kill(pid, signal.SIGKILL)

    rows = track_takes(pattern, out, choices=CHOICES, cluster=address, progress=kill)
    assert [row.status for row in rows] == ["done"] * 3
    alone = track_takes(pattern, tmp_path / "alone", choices=CHOICES)
    assert alone == rows and contents(out) == contents(tmp_path / "alone")
    written = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    (out / "s02" / "pre" / "take-kinefit" / RECORD).unlink()  # as if it had been stopped before its end
    assert track_takes(pattern, out, choices=CHOICES, cluster=address) == rows
    again = {path for path, at in written.items() if path.stat().st_mtime_ns != at}
    assert again and all("s02" in path.parts for path in again)
