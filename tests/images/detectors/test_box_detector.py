"""Anchors, boxes, suppression, and the way from a whole image to the network's and back."""

import numpy as np
import pytest

from kinefit.images.detectors.box_detector import CELLS, BoxDetector, PersonDetector, anchors, decode

ANCHORS = anchors(224, CELLS)


def read(raw, logits):
    return decode(raw, logits, ANCHORS, 224)


def test_anchors_are_those_of_the_network():
    """28 x 28 and 14 x 14 cells with two anchors each, 7 x 7 with six; row by row, at the centres of the cells."""
    found = ANCHORS
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
        points = np.array([[0.0, 0.0], [0.0, -0.3], [0.0, -0.1], [0.0, -0.2]]) + centre - ANCHORS[anchor]
        box = [*(centre - ANCHORS[anchor]), size, size]
        raw[anchor] = np.concatenate([box, points.ravel()]) * 224
        logits[anchor] = logit
    return raw, logits


def test_a_box_is_read_from_its_anchor():
    (points, score), = read(*outputs((500, 2.0, np.array([0.4, 0.6]), 0.2)))
    assert np.allclose(points, [[0.3, 0.5], [0.5, 0.7], [0.4, 0.6], [0.4, 0.3], [0.4, 0.5], [0.4, 0.4]])
    assert score == pytest.approx(1 / (1 + np.exp(-2)))


def test_boxes_of_one_person_are_averaged_by_their_scores_and_others_stay():
    a, b, far = np.array([0.40, 0.6]), np.array([0.42, 0.6]), np.array([0.8, 0.5])
    found = read(*outputs((500, 3.0, a, 0.2), (510, 1.0, b, 0.2), (900, 2.0, far, 0.2), (901, -1.0, far, 0.2)))
    assert [round(score, 4) for _, score in found] == [0.9526, 0.8808]
    weights = 1 / (1 + np.exp(-np.array([3.0, 1.0])))
    assert found[0][0][2, 0] == pytest.approx(np.average([0.40, 0.42], weights=weights))
    assert np.allclose(found[1][0][2], far)


def test_nobody_is_found_where_no_score_is_high():
    assert read(*outputs((500, -0.1, np.array([0.4, 0.6]), 0.2))) == []


class Interpreter:
    """A network that sees one person in the middle of its picture, or whatever it was given."""

    def __init__(self, raw, logits):
        self.tensors = {1: raw[None].astype(np.float32), 2: logits[None, :, None].astype(np.float32)}

    def get_input_details(self):
        return [{"index": 0, "shape": [1, 224, 224, 3]}]

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
    (person,) = BoxDetector(interpreter, CELLS)(np.full((200, 400, 3), 255, np.uint8))
    assert np.allclose(person.points[:2], [[200, 100], [200, 100 - 0.3 * 400]])
    assert np.allclose(person.corners, [[160, 60], [240, 140]])
    (same,) = PersonDetector(interpreter)(np.full((200, 400, 3), 255, np.uint8))
    assert np.allclose(same.points, person.points[:2]) and np.allclose(same.head, person.corners)
    seen = interpreter.tensors[0][0]
    assert seen.shape == (224, 224, 3)
    assert np.all(seen[60:160] == 1) and np.all(seen[:54] == -1) and np.all(seen[-54:] == -1)
