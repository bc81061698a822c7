"""Images that come in while a job runs."""

import pytest
from tests.studio.app.test_live import STUDIO
from tests.studio.viewers.recordings import write_video

from kinefit.errors import FileError
from kinefit.readers.take.file import read_take
from kinefit.readers.videos.video_files import image_at
from kinefit.studio.app.pages.take import _span


def test_an_image_is_from_about_the_share_of_the_video(tmp_path):
    video = write_video(tmp_path / "a.mkv", 30)  # 5 grey values a frame
    first, middle, last = (float(image_at(video, share, timeout=10.0)[-1].mean()) for share in (0.0, 0.5, 1.0))
    assert first == pytest.approx(20, abs=1) and last == pytest.approx(20 + 5 * 29, abs=6)
    assert middle == pytest.approx(20 + 5 * 15, abs=6)
    part = image_at(video, 0.5, start=0.2, stop=0.4, timeout=10.0)
    assert float(part[-1].mean()) == pytest.approx(20 + 5 * 9, abs=6)


def test_what_is_no_video_is_an_error(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video")
    for path in (tmp_path / "a.mp4", tmp_path / "b.mp4"):
        with pytest.raises(FileError):
            image_at(path, 0.5)


def test_only_the_part_of_a_video_that_the_take_uses_is_shown(tmp_path):
    (tmp_path / "a.mp4").touch()
    text = STUDIO + '[[camera]]\nname = "a"\nvideo = "a.mp4"\ntime_offset = 0.5\n'
    (tmp_path / "take.toml").write_text(text)
    take = read_take(tmp_path / "take.toml")
    assert _span(take, take.cameras[0]) == {}
    (tmp_path / "take.toml").write_text(text.replace("[take]\n", "[take]\nframes = [30, 90]\n"))
    take = read_take(tmp_path / "take.toml")
    assert _span(take, take.cameras[0]) == {"start": 0.5, "stop": 2.5}
