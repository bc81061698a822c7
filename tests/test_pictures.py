import struct
import time
import zlib

import cv2
import numpy as np
import pytest

from kinefit._pictures import read_picture
from kinefit.errors import FileError

PICTURE = np.random.default_rng(3).integers(0, 255, (6, 5, 3), np.uint8)


@pytest.fixture
def png(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), PICTURE[..., ::-1])
    return path


def test_pictures_are_rgb_unless_other_flags_are_given(png):
    np.testing.assert_array_equal(read_picture(png), PICTURE)
    np.testing.assert_array_equal(read_picture(png, cv2.IMREAD_UNCHANGED), PICTURE[..., ::-1])


@pytest.mark.parametrize("left", [0, 4, 20, 60])
def test_what_is_cut_is_refused(png, left):
    png.write_bytes(png.read_bytes()[:left])
    with pytest.raises(FileError, match="no image, or damaged"):
        read_picture(png)


def test_lengths_beyond_the_file_are_refused_at_once(png):
    data = png.read_bytes()
    kind = b"pHYs" + b"\0" * 9
    chunk = struct.pack(">I", 1_900_000_000) + kind + struct.pack(">I", zlib.crc32(kind))
    png.write_bytes(data[:33] + chunk + data[33:])
    began = time.process_time()
    with pytest.raises(FileError, match="no image"):
        read_picture(png)
    assert time.process_time() - began < 1.0


def test_a_closing_chunk_that_claims_a_length_is_refused_in_little_memory(png, monkeypatch):
    data = png.read_bytes()
    end = data.rindex(b"IEND") - 4
    png.write_bytes(data[:end] + struct.pack(">I", 2**29) + data[end + 4 :])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the decoder would fill half a gigabyte"))
    with pytest.raises(FileError, match="no image"):
        read_picture(png)


def test_no_file_is_told(tmp_path):
    with pytest.raises(FileError, match="cannot be read"):
        read_picture(tmp_path / "none.png")
