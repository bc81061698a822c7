"""Networks that are none."""

import pytest

from kinefit.errors import FileError
from kinefit.images.detectors.box_detector import DETECTOR, LANDMARKS, Models

pytest.importorskip("ai_edge_litert", reason="needs the extra detect")


@pytest.mark.parametrize("content", [b"", b"garbage" * 9, b"\0\0\0\0TFL3" + bytes(100), b"\x1c\0\0\0TFL3" + bytes(20)])
def test_a_file_that_is_no_network_is_told(tmp_path, monkeypatch, content):
    for name in (LANDMARKS, DETECTOR):
        (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match="not a network that LiteRT runs.*Name a landmark network"):
        Models(tmp_path)
    monkeypatch.setenv("KINEFIT_CACHE", str(tmp_path))
    with pytest.raises(FileError, match="not a network that LiteRT runs.*Delete its folder"):
        Models(tmp_path)


def test_a_missing_network_is_told(tmp_path):
    with pytest.raises(FileError, match="no such network"):
        Models(tmp_path)


def test_a_network_of_other_inputs_and_outputs_is_told():
    from kinefit.errors import AssetError
    from kinefit.readers import assets

    try:
        folder = assets.detector_models()
    except AssetError as error:
        pytest.skip(str(error))
    with pytest.raises(FileError, match=r"without inputs or outputs of shape \(1, 256, 256, 3\).*outputs \(1, 195\)"):
        Models(folder, landmarks=folder / DETECTOR)
