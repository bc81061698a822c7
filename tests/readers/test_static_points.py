"""Static points: read, and refused with the place where something is wrong."""

import pytest

from kinefit.errors import FileError, ObservationError
from kinefit.readers.landmarks.annotations import read_static_points

GOOD = "[beam]\ncam1 = [512.5, 1204]\ncam3 = [430.1, 1311.8]\n"


def written(folder, text):
    (folder / "points.toml").write_text(text, encoding="utf-8")
    return folder / "points.toml"


def test_points_are_read(tmp_path):
    points = read_static_points(written(tmp_path, GOOD), ("cam1", "cam2", "cam3"))
    assert points == {"beam": {"cam1": (512.5, 1204.0), "cam3": (430.1, 1311.8)}}


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        (GOOD.replace("cam3", "cam9"), "[beam] cam9", "no camera 'cam9'; there are: cam1"),
        ("[beam]\ncam1 = [1, 2]\n", "[beam]", "two or more cameras"),
        ("beam = 3\n", "[beam]", "two or more cameras"),
        (GOOD.replace("430.1", "nan"), "[beam] cam3", "not a pixel"),
        (GOOD.replace("512.5, 1204", "512.5"), "[beam] cam1", "not a pixel"),
        ("", None, "no points"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, text, place, message):
    path = written(tmp_path, text)
    with pytest.raises(ObservationError, match=message) as caught:
        read_static_points(path, ("cam1", "cam2", "cam3"))
    assert (caught.value.file, caught.value.place) == (path, place)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(FileError, match="No such file"):
        read_static_points(tmp_path / "none.toml", ("cam1",))
    with pytest.raises(FileError, match="not TOML"):
        read_static_points(written(tmp_path, "[beam\n"), ("cam1",))
