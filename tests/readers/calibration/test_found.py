"""Cameras that were found from people, written and read back."""

import numpy as np
import pytest

from kinefit.errors import FileError, KinefitError
from kinefit.readers.calibration.read import FoundCameras, read_calibration, read_found, write_calibration, write_found
from kinefit.simulation import studio_rig


@pytest.fixture
def found():
    rig = studio_rig(cameras=3)
    return FoundCameras(
        rig=rig, time_offsets=(0.0, -0.25, 1.5), position_sigma=0.08, rotation_sigma=0.7,
        notes=('a "note"', "another"), made_from=("a", "b", "c"), height=1.7,
    )  # fmt: skip


def test_what_is_written_is_read(found, tmp_path):
    write_found(found, tmp_path / "cameras.toml")
    back = read_found(tmp_path / "cameras.toml")
    assert back.time_offsets == found.time_offsets and back.notes == found.notes
    assert back.made_from == found.made_from and back.height == 1.7
    assert (back.position_sigma, back.rotation_sigma) == (0.08, 0.7)
    for a, b in zip(read_calibration(tmp_path / "cameras.toml"), found.rig, strict=True):
        np.testing.assert_allclose(a.T_camera_world, b.T_camera_world, atol=1e-9)


def test_other_calibrations_are_told(found, tmp_path):
    write_calibration(found.rig, tmp_path / "rig.toml")
    with pytest.raises(FileError, match="no whole file of cameras.*another name"):
        read_found(tmp_path / "rig.toml")
    assert read_found(tmp_path / "nothing.toml") is None and read_found(tmp_path) is None


@pytest.mark.parametrize("part", [0.2, 0.5, 0.9, 0.97])
def test_half_a_file_is_told(found, tmp_path, part):
    file = tmp_path / "cameras.toml"
    write_found(found, file)
    text = file.read_text()
    file.write_text(text[: int(part * len(text))])
    with pytest.raises(KinefitError, match="cameras.toml"):
        read_found(file)


def test_one_that_was_changed_is_told(found, tmp_path):
    file = tmp_path / "cameras.toml"
    write_found(found, file)
    text = file.read_text()
    wrong = {"position_sigma": "place_sigma", '"a", ': "", "0.08": "-0.08", "1.5]": "1.5, 2.0]", "1.7": '"tall"'}
    for old, new in wrong.items():
        file.write_text(text.replace(old, new))
        with pytest.raises(FileError, match="is not whole.*made again"):
            read_found(file)
