"""Who is another one's image in a mirror, and who only dances alike."""

import numpy as np
import pytest
from tests.fitting.multiview.test_people import NAMES, along, line, records
from tests.oracle import look_at

from kinefit.fitting.multiview.followed import follow, mark_mirror_images, sentences
from kinefit.fitting.multiview.people import people_of
from kinefit.geometry.camera import Rig
from kinefit.observations.recordings import mirror_name

PLACES = [(4.0 * np.sin(a), 0.3 * k, -4.0 * np.cos(a)) for k, a in enumerate(np.radians([-60.0, -20.0, 20.0, 60.0]))]
RIG = Rig(tuple(look_at(f"cam{k}", np.array(place), np.zeros(3)) for k, place in enumerate(PLACES)))
EXCHANGED = [NAMES.index(m) if (m := mirror_name(name)) in NAMES else k for k, name in enumerate(NAMES)]
FRAMES = 50


def behind_glass(x, normal, plane, exchanged=EXCHANGED):
    """(F, K, 3) the points as a mirror n x = plane shows them, with the names that a detector gives them."""
    return (x - 2.0 * ((x @ normal) - plane)[..., None] * normal)[:, exchanged]


@pytest.mark.parametrize("listed_first", ["person", "image"])
def test_the_image_in_a_mirror_is_nobody_else(listed_first):
    x = along(line((-0.5, 0.0, 0.3), (0.5, 0.0, 0.5), FRAMES), 1)
    image = behind_glass(x, np.array([0.0, 0.0, -1.0]), -1.5)
    keypoints, truth = records([x, image], seed=3, rig=RIG)
    found = people_of(RIG, keypoints)
    assert len(found) == 2
    if np.mean(found[0].chosen[0] == truth[0][:, 0]) < 0.5:
        found = found[::-1]
    if listed_first == "image":
        found = found[::-1]
    told = mark_mirror_images(RIG, keypoints, found)
    assert [one.image_of for one in told] == [None, 0]
    assert np.mean(told[0].chosen[0] == truth[0][:, 0]) > 0.9
    followed = follow(RIG, keypoints)
    assert sentences(followed.as_record(), asked=False)[-1] == "person 2 is the mirror image of person 1"


def test_a_mirror_image_is_found_with_a_point_that_is_never_seen():
    x = along(line((-0.5, 0.0, 0.3), (0.5, 0.0, 0.5), FRAMES), 1)
    x[:, NAMES.index("Nose")] = np.nan
    keypoints, _ = records([x, behind_glass(x, np.array([0.0, 0.0, -1.0]), -1.5)], seed=3, rig=RIG)
    told = mark_mirror_images(RIG, keypoints, people_of(RIG, keypoints))
    assert [one.image_of for one in told] == [None, 0] and all(np.isfinite(one.size) for one in told)


@pytest.mark.parametrize("alike", ["the same side", "half a second later", "still"])
def test_two_who_move_alike_are_two(alike):
    start, end = ((-0.5, 0.0, 0.3), (0.5, 0.0, 0.5)) if alike != "still" else ((0.0, 0.0, 0.4),) * 2
    x = along(line(start, end, FRAMES), 1)
    x = x[:1].repeat(FRAMES, axis=0) if alike == "still" else x
    normal, plane = np.array([0.0, 0.0, -1.0]), -1.5
    if alike == "the same side":
        other = behind_glass(x, normal, plane, np.arange(len(NAMES)))
    else:
        other = behind_glass(np.roll(x, 12, axis=0), normal, plane)
    keypoints, _ = records([x, other], seed=3, rig=RIG)
    assert all(one.image_of is None for one in mark_mirror_images(RIG, keypoints, people_of(RIG, keypoints)))
