"""Anchors, boxes, suppression, and the way back from a turned picture."""

import numpy as np
import pytest

from kinefit.images.detectors.models import squares
from kinefit.images.detectors.person_detector import SIZE, DetectedPerson, PersonDetector, anchors, decode


def test_anchors_are_those_of_the_network():
    """28 x 28 and 14 x 14 cells with two anchors each, 7 x 7 with six; row by row, at the centres of the cells."""
    found = anchors()
    assert found.shape == (28 * 28 * 2 + 14 * 14 * 2 + 7 * 7 * 6, 2)
    assert np.allclose(found[0], 0.5 / 28) and np.allclose(found[0], found[1])
    assert np.allclose(found[2], [1.5 / 28, 0.5 / 28])
    assert np.allclose(found[28 * 28 * 2], 0.5 / 14)
    assert np.allclose(found[-294:-288], 0.5 / 7) and np.allclose(found[-288], [1.5 / 7, 0.5 / 7])
    assert np.allclose(found[-1], 6.5 / 7)


def outputs(*people):
    """The network's numbers where it sees people: (anchor, logit, centre, size) in sides of its picture."""
    raw, logits = np.zeros((2254, 12)), np.full(2254, -10.0)
    for anchor, logit, centre, size in people:
        points = np.array([[0.0, 0.0], [0.0, -0.3], [0.0, -0.1], [0.0, -0.2]]) + centre - anchors()[anchor]
        box = [*(centre - anchors()[anchor]), size, size]
        raw[anchor] = np.concatenate([box, points.ravel()]) * SIZE
        logits[anchor] = logit
    return raw, logits


def test_a_box_is_read_from_its_anchor():
    (points, score), = decode(*outputs((500, 2.0, np.array([0.4, 0.6]), 0.2)))
    assert np.allclose(points, [[0.4, 0.6], [0.4, 0.3], [0.4, 0.5], [0.4, 0.4]])
    assert score == pytest.approx(1 / (1 + np.exp(-2)))


def test_boxes_of_one_person_are_averaged_by_their_scores_and_others_stay():
    a, b, far = np.array([0.40, 0.6]), np.array([0.42, 0.6]), np.array([0.8, 0.5])
    found = decode(*outputs((500, 3.0, a, 0.2), (510, 1.0, b, 0.2), (900, 2.0, far, 0.2), (901, -1.0, far, 0.2)))
    assert [round(score, 4) for _, score in found] == [0.9526, 0.8808]
    weights = 1 / (1 + np.exp(-np.array([3.0, 1.0])))
    assert found[0][0][0, 0] == pytest.approx(np.average([0.40, 0.42], weights=weights))
    assert np.allclose(found[1][0][0], far)


def test_nobody_is_found_where_no_score_is_high():
    assert decode(*outputs((500, -0.1, np.array([0.4, 0.6]), 0.2))) == []


class Interpreter:
    """A network that sees one person in the middle of its picture, or whatever it was given."""

    def __init__(self, raw, logits):
        self.tensors = {1: raw[None].astype(np.float32), 2: logits[None, :, None].astype(np.float32)}

    def get_input_details(self):
        return [{"index": 0}]

    def get_output_details(self):
        return [{"shape": [1, 2254, 12], "index": 1}, {"shape": [1, 2254, 1], "index": 2}]

    def set_tensor(self, index, value):
        self.tensors[index] = value

    def invoke(self):
        pass

    def get_tensor(self, index):
        return self.tensors[index]


def test_the_whole_picture_is_seen_between_black_bars_and_points_come_back():
    interpreter = Interpreter(*outputs((500, 3.0, np.array([0.5, 0.5]), 0.2)))
    (person,) = PersonDetector(interpreter)(np.full((200, 400, 3), 255, np.uint8))
    assert np.allclose(person.points, [[200, 100], [200, 100 - 0.3 * 400]])
    seen = interpreter.tensors[0][0]
    assert seen.shape == (224, 224, 3)
    assert np.all(seen[60:160] == 1) and np.all(seen[:54] == -1) and np.all(seen[-54:] == -1)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_whoever_is_found_in_the_turned_picture_is_turned_back(quarters):
    image = np.zeros((30, 50))
    image[7, 11], image[20, 40] = 1, 2
    turned = np.rot90(image, quarters)
    points = np.array([np.argwhere(turned == value)[0][::-1] for value in (1, 2)], float)
    assert np.allclose(DetectedPerson(points, 1.0).turned_back(quarters, image.shape).points, [[11, 7], [40, 20]])


@pytest.mark.parametrize("size", [(1920, 1080), (1080, 1920), (640, 480), (500, 500)])
def test_squares_cover_the_picture_and_stay_in_it(size):
    covered = np.zeros(size[::-1], int)
    sides = set()
    for u, v, side in squares(*size):
        part = covered[v : v + side, u : u + side]
        assert part.shape == (side, side)
        part += 1
        sides.add(side)
    assert covered.min() >= 1 and min(sides) == min(size) // 2
