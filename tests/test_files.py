"""TOML and numpy archives of any content: an answer within bounds, with the place and what would work."""

import errno
import gc
import io
import os
import sys
import time
import zipfile

import av
import numpy as np
import pytest
from tests.exporters.synthetic import a_camera, smooth_motion
from tests.strangers import ENDINGS, outcome, without_end

from kinefit import exporters
from kinefit._files import npy_header, parse_toml, read_npy, read_npz, regular, stature_of, write_text, writing
from kinefit.errors import BodyError, ExportError, FileError, ObservationError
from kinefit.readers.videos.video import Video


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[a]\nfile = "C:\\Users\\me\\x.toml"', r'line 2.*forward slashes. Write "C:.Users.me.x.toml"'),
        ('file = "C:\\data\\x.toml"', "forward slashes"),
        ("size = True", "Write true"),
        ("name = “walk”", "straight quotes"),
        ('name = walk', 'quotes: name = "walk"'),
        ('[camera]\nname = "a"\n[[camera]]\nname = "b"', r"the first one too: \[\[camera\]\]"),
        ("rate = 30\nrate = 60", "appears twice"),
        ("rate = 29,97", "a point, not a comma"),
        ("a = " + "[" * 5000 + "]" * 5000, "nested too deep"),
        ("a = " + "9" * 5000, "number too long"),
        ("\n" + "a." * 20_000 + "a = 1", "line 2.*more than 50 parts"),
        ("'a'. \"b\" ." * 100 + "a = 1", "more than 50 parts"),
        ("#" * 5_000_000, "5 MB"),
    ],
)
def test_what_is_no_toml_is_told_at_once(text, told):
    began = time.monotonic()
    with pytest.raises(FileError, match=f"(?s)x.toml.*{told}") as error:
        parse_toml(text, "x.toml")
    assert time.monotonic() - began < 2.0 and len(str(error.value)) < 600


def test_the_error_is_of_the_kind_asked_for():
    with pytest.raises(BodyError):
        parse_toml("a = = 1", "x.toml", BodyError)


def test_dots_in_texts_and_numbers_are_no_keys():
    text = "a = '" + "x." * 40 + "'\nb = [" + "1.5, " * 500 + "]\nc.d.e = 1"
    assert parse_toml(text, "x.toml")["c"] == {"d": {"e": 1}}


def archive(path, **members):
    """A zip archive of raw bytes and arrays."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        for name, content in members.items():
            if isinstance(content, np.ndarray):
                stream = io.BytesIO()
                np.save(stream, content)
                content = stream.getvalue()
            out.writestr(f"{name}.npy", content)
    return path


def header(text):
    """The begin of a numpy array that says what it likes."""
    data = text.encode()
    data += b" " * (-(len(data) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(data).to_bytes(2, "little") + data


def test_arrays_come_back_as_numpy_reads_them(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6).reshape(2, 3)), "c": np.array("é"),
              "d": np.zeros((0, 3), np.float32), "e": np.array(["x", "yz"]), "f": np.array(True)}  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz", remedy="")
    with np.load(tmp_path / "a.npz") as known:
        for name in arrays:
            np.testing.assert_array_equal(found[name], known[name])
            assert found[name].dtype == known[name].dtype and found[name].flags.writeable
    assert set(read_npz(tmp_path / "a.npz", "a", "none", remedy="")) == {"a"}
    np.save(tmp_path / "b.npy", arrays["b"])
    np.testing.assert_array_equal(read_npy(tmp_path / "b.npy", remedy=""), arrays["b"])
    assert npy_header(tmp_path / "b.npy") == ((2, 3), np.dtype(int))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,)}"), "but there are 128 bytes"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}"), "but there are"),
        (header("{'descr': '<U0', 'fortran_order': False, 'shape': (9999999999,)}"), "but there are"),
        (header("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}"), "not of numbers or texts"),
        (header("{'descr': '<U1', 'fortran_order': False, 'shape': (1,)}") + b"\xff" * 4, "that do not exist"),
        (header("(" * 5000), "damaged"), (b"no array", "damaged"), (b"", "damaged"),
    ],
)  # fmt: skip
def test_a_member_that_is_no_array_is_told(tmp_path, content, told):
    with pytest.raises(BodyError, match=f"(?s)a.npz.*{told}.*Copy it"):
        read_npz(archive(tmp_path / "a.npz", a=content), remedy="Copy it.", error=BodyError)
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(FileError, match=r"a\.npy.*Copy it"):
        read_npy(tmp_path / "a.npy", remedy="Copy it.")


def test_an_archive_that_unpacks_to_very_much_is_not_unpacked(tmp_path):
    path = archive(tmp_path / "a.npz", a=np.zeros(40_000_000))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(FileError, match="320 MB, but the file is much smaller"):
        read_npz(path, remedy="")
    assert read_npz(archive(tmp_path / "b.npz", a=np.zeros(4_000_000)), remedy="")["a"].shape == (4_000_000,)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_an_archive_that_is_cut_is_told(tmp_path, share):
    path = archive(tmp_path / "a.npz", a=np.random.default_rng(0).random(1000))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(FileError, match="damaged"):
        read_npz(path, remedy="")


def test_flipped_bytes_of_packed_data_are_told(tmp_path):
    path = archive(tmp_path / "a.npz", a=np.random.default_rng(0).random(1000))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))
    with pytest.raises(FileError, match="damaged"):
        read_npz(path, remedy="")


_REMEDY = "Copy what it gives into a file, and name that."


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes in folders")
@pytest.mark.parametrize("kind", ["pipe", "link to a pipe", "link to /dev/zero", "socket"])
@pytest.mark.parametrize("reader", ENDINGS)
def test_readers_refuse_files_without_an_end(reader, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    for name in ENDINGS[reader]:
        (tmp_path / name[2:]).mkdir()
        path = tmp_path / name[2:] / name
        without_end(path.parent)[kind](path)
        assert outcome(reader, path).endswith(f"{name}: a pipe, socket or device, not a file. {_REMEDY}")


def test_regular_files_folders_and_missing_ones_are_passed_on(tmp_path):
    (tmp_path / "a").write_text("a")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    for path in (tmp_path / "a", tmp_path / "b", tmp_path, tmp_path / "none", tmp_path / "a" / "none"):
        assert regular(path) == path and regular(str(path)) == path


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


@pytest.mark.parametrize("text", ["1.75", "1,75", "175", "175 cm", "175cm", "1.75 m", "1,75m", "1750 mm", 1.75, 175])
def test_a_stature_is_read_as_people_write_it(text):
    assert stature_of(text) == 1.75


@pytest.mark.parametrize("text", ["", "tall", "17.5", "1750", "0.2", "1.75 kg", "-1.75", "1.7.5", "nan", "175 m"])
def test_what_is_no_stature_says_what_to_give(text):
    with pytest.raises(ObservationError, match="no stature.*1.75 or 175"):
        stature_of(text)
