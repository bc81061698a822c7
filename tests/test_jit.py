"""Kernels give the same bits whether they were compiled or loaded, and only a safe cache is used."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from kinefit import _jit

# Many poses and one: a kernel beside another that calls it, too large to be inlined unasked.
PROGRAM = """
import sys
import numpy as np
from kinefit._jit import kernel_folder
from kinefit.bodies import load_body
from kinefit.bodies._kernels import forward

tree = load_body("humanoid").tree
roots, angles = np.tile(np.eye(4), (8, 1, 1)), np.random.default_rng(0).normal(size=(8, len(tree.coordinates)))
many = lambda: tree.segment_poses(roots, angles)
one = lambda: np.stack([np.concatenate(tree.forward(T, q), axis=None) for T, q in zip(roots, angles)])
first, second = (one, many) if sys.argv[1:] else (many, one)
bits = sorted([first().tobytes().hex(), second().tobytes().hex()], key=len)
print(*bits, sum(forward.stats.cache_hits.values()), kernel_folder())
"""
ROOT = Path(__file__).resolve().parents[1]


def run(cache, *arguments, **environment):
    """Bits of the sums, how many kernels came from the cache, its folder, and what was said on stderr."""
    kept = {"PATH": os.environ.get("PATH", ""), "PYTHONPATH": str(ROOT / "src"), "KINEFIT_CACHE": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments], env=kept | environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    *bits, hits, folder = done.stdout.split()
    return bits, int(hits), Path(folder), done.stderr


def test_compiled_or_loaded_in_any_order_a_kernel_gives_the_same_bits(tmp_path):
    bits, hits, folder, told = run(tmp_path / "cache")
    assert hits == 0 and folder.parents[1] == tmp_path / "cache" and not told
    assert folder.stat().st_mode & 0o077 == 0
    for order in ([], ["one pose first"]):
        again, hits, _, told = run(tmp_path / "cache", *order)
        assert hits == 1 and again == bits and not told


def test_damaged_files_are_compiled_anew(tmp_path):
    bits, _, folder, _ = run(tmp_path)
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".nbi", ".nbc"}
    for path in files:
        raw = bytearray(path.read_bytes())
        raw[len(raw) // 2] ^= 0xFF
        path.write_bytes(raw if path.suffix == ".nbc" else raw[: len(raw) // 2])
    again, hits, _, _ = run(tmp_path)
    assert hits == 0 and again == bits
    again, hits, _, told = run(tmp_path)
    assert hits == 1 and again == bits and not told


def test_a_folder_that_cannot_be_written_is_told_once_and_gone_without(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir(mode=0o700)
    _, hits, folder, told = run(tmp_path / "file", TMPDIR=str(tmp_path / "temporary"))
    assert hits == 0 and folder.is_relative_to(tmp_path / "temporary")
    assert told.count("RuntimeWarning: compiled kernels are kept in") == 1 and str(tmp_path / "file") in told


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A cache and a temporary folder to choose from, as if nothing had been chosen yet."""
    monkeypatch.setenv("KINEFIT_CACHE", str(tmp_path / "cache"))
    (tmp_path / "temporary").mkdir(mode=0o700)
    monkeypatch.setattr(_jit.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    monkeypatch.setattr(_jit, "_told", list)
    return tmp_path / "cache", tmp_path / "temporary"


def choose():
    return _jit.kernel_folder.__wrapped__()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="folders have no modes here")
class TestStrangers:
    def test_a_folder_of_its_own_is_private_and_stays(self, places):
        folder = choose()
        assert folder.is_relative_to(places[0])
        assert [path.stat().st_mode & 0o777 for path in (folder, *folder.parents[:2])] == [0o700] * 3
        assert choose() == folder

    @pytest.mark.parametrize("depth", [0, 1, 2])
    @pytest.mark.parametrize("mode", [0o777, 0o757])
    def test_what_others_could_have_written_is_not_used(self, places, depth, mode):
        [choose(), *choose().parents][depth].chmod(mode)
        with pytest.warns(RuntimeWarning, match=r"kept in .*temporary.*(others may write to|open to others).*cache"):
            assert choose().is_relative_to(places[1])

    def test_others_may_write_beside_it_if_they_cannot_replace_it(self, places):
        places[0].mkdir()
        places[0].chmod(0o1777)
        assert choose().is_relative_to(places[0])

    def test_the_folder_of_another_user_is_not_used(self, places, monkeypatch):
        choose()
        other = os.geteuid() + 1
        monkeypatch.setattr(_jit, "_user", lambda: other)
        with pytest.warns(RuntimeWarning, match="compiled at every start.*another user"):
            assert choose() is None

    def test_a_link_leads_to_what_is_looked_at(self, places, tmp_path):
        (tmp_path / "open").mkdir()
        (tmp_path / "open").chmod(0o777)
        places[0].symlink_to(tmp_path / "open")
        with pytest.warns(RuntimeWarning, match="others may write to .*open"):
            assert choose().is_relative_to(places[1])


def test_without_a_home_the_temporary_folder_takes_its_place(places, monkeypatch):
    monkeypatch.delenv("KINEFIT_CACHE")

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(_jit.Path, "home", homeless)
    assert choose().is_relative_to(places[1]) and _jit.cache_directory().is_relative_to(places[1])


def test_where_nothing_can_be_written_kernels_are_compiled_and_not_kept(places, monkeypatch):
    places[0].touch()
    places[1].rmdir()
    places[1].touch()
    with pytest.warns(RuntimeWarning, match="compiled at every start.*KINEFIT_CACHE"):
        assert choose() is None
    monkeypatch.setattr(_jit, "kernel_folder", lambda: None)
    doubled = _jit.jit(lambda x: 2.0 * x)
    assert doubled(1.5) == 3.0 and not sum(doubled.stats.cache_hits.values())


def test_a_full_disk_stops_no_kernel(tmp_path, monkeypatch):
    monkeypatch.setattr(_jit, "kernel_folder", lambda: tmp_path)
    monkeypatch.setattr(_jit, "_told", list)
    tripled = _jit.jit(lambda x: 3.0 * x)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_jit.caching.FunctionCache, "_save_overload", full)
    with pytest.warns(RuntimeWarning, match="No space left"):
        assert tripled(2.0) == 6.0
