"""Colours of left, right, middle and lost: far apart for people with any common colour vision deficiency."""

from itertools import combinations

import cv2
import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.rendering import looks
from kinefit.bodies.rendering.looks import body_mesh
from kinefit.exporters.report.figure import live_figure
from kinefit.exporters.report.page import CENTRE_COLOUR, LEFT_COLOUR, RIGHT_COLOUR

# Machado, Oliveira and Fernandes, IEEE TVCG 15 (2009), severity 1: of linear RGB.
DEFICIENCIES = {
    "none": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}


def lab(rgb, deficiency):
    """CIELab of an RGB colour as it looks to somebody."""
    linear = np.clip(np.array(DEFICIENCIES[deficiency]) @ (np.array(rgb, float) / 255.0) ** 2.2, 0.0, 1.0)
    return cv2.cvtColor(np.float32(linear ** (1 / 2.2)).reshape(1, 1, 3), cv2.COLOR_RGB2Lab).reshape(3)


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_sides_and_lost_differ_for_everybody(deficiency):
    named = (looks.LEFT_COLOUR, looks.RIGHT_COLOUR, looks.CENTRE_COLOUR, looks.LOST_COLOUR)
    gaps = [np.linalg.norm(lab(a, deficiency) - lab(b, deficiency)) for a, b in combinations(named, 2)]
    print(deficiency, np.round(gaps, 1))
    assert min(gaps) > 12.0


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_good_and_bad_quality_differ_for_everybody(deficiency):
    good, middling, bad = (lab(c, deficiency) for c in looks.quality_ramp([0.0, 0.5, 1.0]))
    assert min(np.linalg.norm(a - b) for a, b in combinations((good, middling, bad), 2)) > 25.0


def test_every_place_uses_the_same_colours():
    body = load_body("humanoid")
    sides = {"_l": looks.LEFT_COLOUR, "_r": looks.RIGHT_COLOUR}
    expected = [sides.get(name[-2:], looks.CENTRE_COLOUR) for name in body.tree.segments]
    assert [tuple(c) for c in looks.side_colours(body)] == expected
    assert {tuple(c) for c in body_mesh(body).colours} == set(expected)
    sides = LEFT_COLOUR, RIGHT_COLOUR, CENTRE_COLOUR
    assert sides == tuple(map(looks.to_hex, (looks.LEFT_COLOUR, looks.RIGHT_COLOUR, looks.CENTRE_COLOUR)))
    page = str(live_figure(body))
    lost = looks.to_hex(looks.LOST_COLOUR)
    assert all(colour in page for colour in (LEFT_COLOUR, RIGHT_COLOUR, CENTRE_COLOUR, lost))
