"""What is kept of many frames: read back as it was, beyond a little memory from a file that does not outlive it."""

import errno
import gc
import tempfile
import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.errors import ExportError
from kinefit.fitting.smoothing.spool import Spool
from kinefit.sensors.base import Leftover, Measurement, RowsOf

BODY = load_body("humanoid10")


class Own(Measurement):
    """Of a sensor of one's own: holds what no file can."""

    def __init__(self, time):
        self.sensor, self.time, self.ask = "own", time, lambda: time

    def match(self, scene, reach):
        return RowsOf(self.ask)


@dataclass(frozen=True)
class Foreign:
    values: np.ndarray


def anchors(i):
    return SurfaceAnchors(BODY, np.arange(3) + i, np.full((3, 3), i / 3), np.ones((3, 3)))


def deleted(folder):
    """Open files in a folder that have no name any more."""
    links = [p.readlink() for p in Path("/proc/self/fd").iterdir() if p.is_symlink()]
    return [link for link in links if str(link).startswith(str(folder))]


@pytest.mark.parametrize("in_memory", [0, None])
def test_what_is_read_is_what_was_written(in_memory):
    spool = Spool([(anchors(i), f"frame {i}", {"u": 0.1 * i}) for i in range(20)], in_memory=in_memory)
    assert len(spool) == 20
    for i in (7, 0, 19, -1, 7):
        found, name, more = spool[i]
        k = range(20)[i]
        assert name == f"frame {k}" and more == {"u": 0.1 * k}
        assert found.body is BODY  # bodies belong to all frames
        for field in ("segment", "points", "normals"):
            mine, own = getattr(found, field), getattr(anchors(k), field)
            np.testing.assert_array_equal(mine, own)
            assert mine.dtype == own.dtype
    assert [name for _, name, _ in spool[3:9:2]] == ["frame 3", "frame 5", "frame 7"]
    assert [name for _, name, _ in spool.chosen([8, 2])[::-1]] == ["frame 2", "frame 8"]
    with pytest.raises(IndexError):
        spool[20]


def test_one_that_is_replaced_is_read_anew_and_its_parts_keep_theirs():
    spool = Spool([np.zeros(2), np.ones(2)], in_memory=0)
    part = spool[1:]
    assert spool[1][0] == 1.0
    spool[1] = np.full(2, 5.0)
    assert spool[1][0] == 5.0 and part[0][0] == 1.0 and spool[0][0] == 0.0


def test_objects_that_are_not_kinefits_stay_as_they_are():
    own, foreign, rows = Own(0.5), Foreign(np.arange(3.0)), RowsOf(lambda scene: None, {"k": np.arange(2)})
    spool = Spool([(own, foreign, rows)], in_memory=0)
    found = spool[0]
    assert found[0] is own and found[1] is foreign
    assert found[2].make is rows.make
    np.testing.assert_array_equal(found[2].about["k"], [0, 1])


def test_memory_does_not_grow_with_what_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    nothing = np.full((20, 1), np.nan)

    def leftover(i):
        values = np.random.default_rng(i).normal(size=(20, 500))
        return Leftover("cam", ("a",) * 20, np.arange(20), values, np.ones(20), "px", nothing)

    spool = Spool(in_memory=2**16)
    spool.append(leftover(0))
    tracemalloc.start()
    for i in range(100):
        spool.append(leftover(i))
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 0.1 * 100 * 20 * 500 * 8
    np.testing.assert_array_equal(spool[100].values, leftover(99).values)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs a list of open files")
@pytest.mark.parametrize("end", [None, ValueError, KeyboardInterrupt])
def test_its_file_has_no_name_and_is_gone_with_it(tmp_path, monkeypatch, end):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def use():
        spool = Spool([np.arange(1000.0)], in_memory=0)
        assert not list(tmp_path.iterdir()) and len(deleted(tmp_path)) == 1
        if end is not None:
            raise end
        return spool[0][3]

    if end is None:
        assert use() == 3.0
    else:
        with pytest.raises(end):
            use()
    gc.collect()
    assert not deleted(tmp_path)


def test_no_room_is_told_with_what_helps(monkeypatch):
    spool = Spool(in_memory=0)

    def full(data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(spool._store._records._file, "write", full)
    with pytest.raises(ExportError, match=r"No space left on device.*TMPDIR"):
        spool.append(np.zeros(3))
