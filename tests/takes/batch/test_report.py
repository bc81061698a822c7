"""The report of a track: pictures of the right frames, links to what lies beside it, what was done."""

import hashlib
import json
import re

import pytest

from kinefit.exporters.report.report import report_frames
from kinefit.readers.take.file import read_take
from kinefit.takes.batch.results import provenance, take_pictures, write_track_report
from kinefit.takes.track import track_take


@pytest.fixture(scope="module")
def tracked(drawn_take):
    take = read_take(drawn_take)
    return (*track_take(take), take)


def silent(*told):
    pass


def test_every_camera_has_a_picture_of_every_frame_to_show(tracked):
    motion, seen, take = tracked
    told = []
    pictures = take_pictures(motion, take, seen, lambda *step: told.append(step))
    assert set(pictures) == set(seen.videos) and told[-1] == ("images", 4, 4)
    for frames in pictures.values():
        assert set(frames) == set(report_frames(motion))
        for picture in frames.values():
            assert picture.ndim == 3 and picture.shape[0] < 960  # the person, not the whole picture


def test_the_report_lies_beside_the_results_and_links_to_them(tracked, tmp_path):
    motion, seen, take = tracked
    files = {"motion": tmp_path / "motion.npz", "overlays": tmp_path / "overlays"}
    write_track_report(motion, take, seen, tmp_path, silent, files)
    text = files["report"].read_text("utf-8")
    assert files["report"] == tmp_path / "report.html" and files["report"].stat().st_size < 8e6
    assert 'href="motion.npz"' in text and 'href="overlays"' in text and "videos with the fitted skeleton" in text
    assert text.count("data:image/jpeg") >= 4 * 3
    assert str(tmp_path) not in text


def test_a_take_without_videos_has_a_report_without_pictures(tracked, tmp_path):
    from dataclasses import replace

    motion, seen, take = tracked
    notes = "cam01 is off", "No height is stated."
    write_track_report(motion, take, replace(seen, videos={}), tmp_path, silent, {}, notes=notes)
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "data:image" not in text
    assert "cam01 is off.<" in text and "No height is stated.<" in text  # one full stop each


def test_the_provenance_names_files_with_their_content_and_no_place(tracked):
    _, _, take = tracked
    found = provenance(take, smoothing={"window": 5})
    assert json.loads(json.dumps(found)) == found
    digest = hashlib.sha256(take.calibration.file.read_bytes()).hexdigest()
    assert found["calibration"]["sha256"] == digest and found["smoothing"] == {"window": 5}
    assert [entry["camera"] for entry in found["keypoints"]] == [entry.camera for entry in take.keypoints]
    assert found["packages"]["numpy"] and re.match(r"\d", found["kinefit"])
    assert str(take.path.parent) not in json.dumps(found)
