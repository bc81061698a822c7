"""Interlaced video of a real recording: the file keeps both fields, and each is one instant (P4 2.1)."""

import av
import cv2
import numpy as np
import pytest
from av.codec.context import Flags

from kinefit.cli.surfaces._measure import field_of
from kinefit.images.photogrammetry.least_squares_matching import match
from kinefit.images.photogrammetry.matching.multi_image import search_box
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.readers.videos.video import Video

FIRST, FRAMES = 20, 4


def woven(frames):
    """Interlaced frames: odd lines (the first, third ...) of one image, even ones of the next."""
    out = []
    for one, other in zip(frames[::2], frames[1::2]):
        image = one.copy()
        image[1::2] = other[1::2]
        out.append(image)
    return out


def write_interlaced(path, images):
    """MPEG-2 with interlaced motion and transform, as broadcast has it."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg2video", rate=30, options={"qscale": "2", "qmin": "2", "qmax": "2"})
        stream.width, stream.height, stream.pix_fmt = images[0].shape[1], images[0].shape[0], "yuv422p"
        stream.codec_context.flags |= Flags.interlaced_dct | Flags.interlaced_me
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def recording(data_dir, tmp_path_factory):
    """A walker's images at 60 Hz, and what an interlaced file of them at 30 Hz gives when it is read."""
    path = tmp_path_factory.mktemp("interlaced") / "walk.mpg"
    with Video(data_dir("video_two_people_4cam") / "cam01.mp4") as video:
        frames = [video.read(FIRST + k) for k in range(2 * FRAMES)]
    write_interlaced(path, woven(frames))
    with Video(path) as video:
        return frames, [video.read(k) for k in range(FRAMES)]


def grey(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float)


def moving(frames):
    """Where two neighbouring images of the recording differ by more than noise."""
    return np.abs(grey(frames[1]) - grey(frames[0])) > 25.0


def test_each_field_of_the_file_is_one_instant(recording):
    frames, read = recording
    for k, image in enumerate(read):
        for field, source in (("odd", frames[2 * k]), ("even", frames[2 * k + 1])):
            off = np.abs(field_of(grey(image), field) - field_of(grey(source), field))
            assert off.mean() < 2.0, (k, field)  # [grey levels] of the compression
        there = moving(frames[2 * k : 2 * k + 2])
        assert there.sum() > 2000
        own, other = field_of(grey(frames[2 * k]), "even"), field_of(grey(image), "even")
        assert np.abs(other - own)[field_of(there, "even")].mean() > 15.0  # the lines between are of another time


def test_points_are_followed_from_field_to_field_as_in_the_images_themselves(recording):
    """Matches on odd lines alone agree with those on the odd lines of the recording; on both fields many are lost."""
    frames, read = recording
    there = cv2.erode(cv2.dilate(moving(frames).astype(np.uint8), np.ones((15, 15))), np.ones((9, 9)))
    v, u = np.nonzero(there[::12, ::12])
    at = np.stack([12.0 * u, 12.0 * v], axis=1)
    at = at[(at > 60).all(axis=1) & (at[:, 0] < there.shape[1] - 60) & (at[:, 1] < there.shape[0] - 60)]
    assert len(at) > 100

    def followed(old, new, places):
        a, b = SplineImage.of(old), SplineImage.of(new)
        box = search_box(a, b, places, places, reach=12, window=21)
        found = match(a, b, places, np.where(np.isfinite(box.uv), box.uv, places), window=21)
        return found.uv, found.found & (found.correlation > 0.8)

    half = at * [1.0, 0.5]
    here, good = followed(field_of(read[0], "odd"), field_of(read[1], "odd"), half)
    true, right = followed(field_of(frames[0], "odd"), field_of(frames[2], "odd"), half)
    both = good & right
    off = np.linalg.norm((here - true)[both], axis=1)
    assert both.sum() > 50 and np.median(off) < 0.1
    whole, kept = followed(read[0], read[1], at)
    wrong = ~kept | (np.linalg.norm((whole - np.array(true) * [1.0, 2.0]), axis=1) > 2.0)
    assert wrong[right].mean() > (~good[right] | (np.linalg.norm((here - true)[right], axis=1) > 1.0)).mean() + 0.05
