"""Files come whole or not at all, whatever goes wrong."""

import errno
import gc
import os

import av
import numpy as np
import pytest
from tests.exporters.synthetic import a_camera, smooth_motion

from kinefit import exporters
from kinefit.errors import ExportError
from kinefit.exporters.atomic import write_text, writing
from kinefit.readers.video import Video

MOTION = smooth_motion(30)
OLD = b"what was here before"


def overlay(motion, path):
    source = path.parent / "source" / "video.mp4"
    with Video(source) as video:
        exporters.write_overlay(motion, a_camera("cam 0", 0.0), video, path)


WRITERS = {
    "motion.npz": exporters.write_motion,
    "motion.bvh": exporters.write_bvh,
    "motion.trc": exporters.write_trc,
    "motion.mot": exporters.write_mot,
    "body.osim": lambda motion, path: exporters.write_osim(motion.body, path),
    "motion.glb": exporters.write_glb,
    "angles.csv": lambda motion, path: exporters.write_csv(motion, path.parent),
    "montage.png": lambda motion, path: exporters.write_montage(
        {"a": np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)}, path
    ),
    "overlay.mp4": overlay,
}


@pytest.fixture
def folder(tmp_path):
    """A folder that has a small noisy video in it."""
    (tmp_path / "source").mkdir()
    with av.open(str(tmp_path / "source" / "video.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=60)
        stream.width, stream.height, stream.pix_fmt = 320, 480, "yuv420p"
        images = np.random.default_rng(0).integers(0, 255, (12, 480, 320, 3), np.uint8)
        for image in [*images, None]:
            container.mux(stream.encode(None if image is None else av.VideoFrame.from_ndarray(image, format="rgb24")))
    return tmp_path


def files_in(folder):
    return sorted(p.name for p in folder.iterdir() if p.is_file())


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_nothing_else(name, folder):
    resource = pytest.importorskip("resource")
    path = folder / name
    WRITERS[name](MOTION, path)  # it works, and all kernels are compiled
    for other in [*folder.glob("*.*")]:
        other.unlink()
    path.write_bytes(OLD)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(ExportError) as caught:
            WRITERS[name](MOTION, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.file == path
    assert "Free some space" in str(caught.value)
    assert path.read_bytes() == OLD
    assert files_in(folder) == [name]
    del caught
    gc.collect()  # an archive that old numpy abandons closes now, and not while the next one's disk is full


@pytest.mark.parametrize("name", WRITERS)
def test_a_failure_at_the_last_step_leaves_nothing(name, folder, monkeypatch):
    def replace(source, target):
        assert os.path.getsize(source) > 0
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(ExportError, match="No space left"):
        WRITERS[name](MOTION, folder / name)
    assert files_in(folder) == []


def test_an_interrupt_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(OLD)
    with pytest.raises(KeyboardInterrupt), writing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_bytes() == OLD and files_in(tmp_path) == ["a.txt"]


def test_folders_on_the_way_are_made_and_obstacles_are_told(tmp_path):
    write_text(tmp_path / "a" / "b.txt", "ä\n")
    assert (tmp_path / "a" / "b.txt").read_bytes() == "ä\n".encode()
    for path in (tmp_path / "a", tmp_path / "a" / "b.txt" / "c.txt"):
        with pytest.raises(ExportError, match="in the way"):
            write_text(path, "x")
    assert files_in(tmp_path) == []


@pytest.mark.skipif(os.name != "posix", reason="processes are asked for by POSIX")
def test_what_a_killed_process_left_goes_with_the_next(tmp_path):
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    kept = [f".a[1]-{os.getppid()}.npz", f".a[1]-{child}.csv", ".a[1]-x.npz", f".b-{child}.npz"]
    for name in [f".a[1]-{child}.npz", *kept]:
        (tmp_path / name).write_bytes(b"half")
    write_text(tmp_path / "a[1].npz", "whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*kept, "a[1].npz"])
