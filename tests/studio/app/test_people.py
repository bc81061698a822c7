"""Pictures of the people of a take."""

import cv2
import numpy as np
import pytest
from tests.readers.two_people import COUNT, motions, write_take

from kinefit.readers.take.file import read_take
from kinefit.simulation import studio_rig
from kinefit.studio.app import people
from kinefit.studio.app.people import PeoplePictures, people_pictures


@pytest.fixture
def take(tmp_path):
    """Two people, with videos of all cameras in stripes."""
    file = write_take(tmp_path)
    rig = studio_rig(motions()[0])
    text = file.read_text()
    for camera in rig:
        image = np.zeros((camera.size[1], camera.size[0], 3), np.uint8)
        image[np.arange(len(image)) // 16 % 2 == 0] = 220
        out = cv2.VideoWriter(str(tmp_path / f"{camera.name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, camera.size)
        for _ in range(COUNT):
            out.write(image)
        out.release()
        entry = f'[[camera]]\nname = "{camera.name}"\n'
        text = text.replace(entry, f'{entry}video = "{camera.name}.mp4"\n')
    file.write_text(text)
    return file


def test_each_person_has_a_picture_as_tall_as_the_keypoints(take):
    pictures = people_pictures(take, hide_faces=False)
    assert [picture.number for picture in pictures] == [1, 2]
    size = next(iter(studio_rig(motions()[0]))).size
    for picture in pictures:
        height, width = picture.image.shape[:2]
        assert 0.3 * size[1] < height <= size[1] and width < size[0] and np.ptp(picture.image) > 200


def test_a_take_that_names_a_person_still_shows_all(take):
    take.write_text(take.read_text().replace("[take]\n", "[take]\nperson = 2\n"))
    assert len(people_pictures(take, hide_faces=False)) == 2


def test_nothing_is_detected_here(copy_take, tmp_path, monkeypatch):
    monkeypatch.setattr("kinefit.takes.preparing.detecting.networks", lambda *_: pytest.fail("it detects"))
    file = copy_take(tmp_path / "drawn")
    text = file.read_text()
    file.write_text(text[: text.index("[[keypoints]]")] if "[[keypoints]]" in text else text)
    assert any(camera.video for camera in read_take(file).cameras) or not read_take(file).keypoints
    assert people_pictures(file, hide_faces=False) == ()
    assert people_pictures(tmp_path / "nowhere.toml", hide_faces=False) == ()


def test_pictures_are_made_once_and_again_when_faces_are_to_be_hidden(take, monkeypatch):
    known, made = PeoplePictures(), []
    real = people.people_pictures

    def counted(file, *, hide_faces):
        made.append(hide_faces)
        return real(file, hide_faces=hide_faces)

    monkeypatch.setattr(people, "people_pictures", counted)
    shown = known.of(take, hide_faces=False)
    assert known.of(take, hide_faces=False) is shown and made == [False]
    assert known.known(take, 2, hide_faces=False) is shown[1].image
    assert known.known(take, 2, hide_faces=True) is None and known.known(take, 3, hide_faces=False) is None
    hidden = known.of(take, hide_faces=True)
    assert made == [False, True] and hidden[1].image.shape == shown[1].image.shape
    edges = [np.abs(np.diff(picture.image.astype(int), axis=0)).max() for picture in (shown[1], hidden[1])]
    assert edges[1] < edges[0] / 3  # unrecognisable, as faces were not looked for yet
