"""The lens that a video file states."""

import struct

import av
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.readers.guess.cameras import field_of_view, stated_focal_length
from kinefit.readers.take.file import read_take

KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def write(path, metadata):
    """A short video; FFmpeg writes the names and values into moov/meta as Apple does."""
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update(metadata)
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(5):
            frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def box(kind, content):
    return struct.pack(">I4s", 8 + len(content), kind) + content


def moov(data, *, of_track, version):
    """A file's moov box with one key, and its value as a `data` box has it."""
    keys = box(b"keys", bytes(4) + struct.pack(">I", 2) + box(b"mdta", b"other") + box(b"mdta", KEY.encode()))
    items = box(b"ilst", box(struct.pack(">I", 2), box(b"data", data)))
    meta = box(b"meta", bytes(4 * version) + box(b"hdlr", bytes(24)) + keys + items)
    return box(b"ftyp", b"qt  ") + box(b"wide", b"") + box(b"moov", box(b"trak", meta) if of_track else meta)


@pytest.mark.parametrize("kind", ["mp4", "mov"])
def test_a_file_states_its_lens(tmp_path, kind):
    assert stated_focal_length(write(tmp_path / f"a.{kind}", {"artist": "me", KEY: "27"})) == 27.0
    assert stated_focal_length(write(tmp_path / f"b.{kind}", {"artist": "me"})) is None


@pytest.mark.parametrize(("kind", "value"), [(21, struct.pack(">i", 13)), (21, b"\r"), (23, struct.pack(">f", 13.0)),
                                             (24, struct.pack(">d", 13.0)), (1, b"13")])  # fmt: skip
@pytest.mark.parametrize("of_track", [True, False])
@pytest.mark.parametrize("version", [True, False])
def test_numbers_of_all_types_in_file_and_track(tmp_path, kind, value, of_track, version):
    path = tmp_path / "a.mov"
    path.write_bytes(moov(struct.pack(">II", kind, 0) + value, of_track=of_track, version=version))
    assert stated_focal_length(path) == 13.0


def test_a_file_that_is_cut_or_no_video_states_nothing(tmp_path):
    path = tmp_path / "a.mov"
    whole = moov(struct.pack(">II", 1, 0) + b"13", of_track=True, version=False)
    for end in range(len(whole)):
        path.write_bytes(whole[:end])
        assert stated_focal_length(path) is None
    for data in (struct.pack(">II", 1, 0) + b"x", struct.pack(">II", 23, 0), struct.pack(">II", 21, 0), b""):
        path.write_bytes(moov(data, of_track=True, version=False))
        assert stated_focal_length(path) is None
    assert stated_focal_length(tmp_path / "none.mov") is None


def test_a_wide_lens_sees_wider():
    assert 55.0 < field_of_view(26.0) < 65.0 and 95.0 < field_of_view(13.0) < 105.0


def test_init_takes_the_lens_from_the_file(tmp_path):
    tmp_path = tmp_path / "alone"  # calibrations beside the folder would be taken, too
    tmp_path.mkdir()
    write(tmp_path / "a.mov", {KEY: "13"})
    write(tmp_path / "b.mov", {})
    done = CliRunner().invoke(main, ["init", str(tmp_path)])
    assert done.exit_code == 0, done.output
    fields = [camera.field_of_view for camera in read_take(tmp_path / "take.toml").cameras]
    assert fields == [round(field_of_view(13.0), 1), 64.0]
    assert "the file states a lens of 13 mm" in (tmp_path / "take.toml").read_text()
