"""Jobs on a Dask cluster; skipped where it is not installed."""

import sys

import pytest
from tests.batch import jobs

from kinefit.batch.cluster import run_there
from kinefit.batch.processes import Failure
from kinefit.errors import ExportError


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ExportError, match=r"kinefit\[cluster\]"):
        next(run_there(jobs.square, [1], address="tcp://127.0.0.1:1", retries=0))


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp://"
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
    from kinefit.batch import cluster as module

    monkeypatch.setattr(module, "code_digest", lambda calls=[]: calls.append(1) or len(calls))
    with pytest.raises(ExportError, match="another kinefit"):
        results(jobs.square, [1], cluster)


def test_no_scheduler_is_told(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("kinefit.batch.cluster._PATIENCE", 0.3)
    with pytest.raises(ExportError, match="no scheduler answers"):
        results(jobs.square, [1], "tcp://127.0.0.1:9")
    with pytest.raises(ExportError, match="no scheduler answers"):
        results(jobs.square, [1], "nonsense://x")
