"""Poses of marker sequences: forwards and backwards in time."""

from dataclasses import replace

import numpy as np

from kinefit import BodyState, load_body, read_markers
from kinefit.fitting.markers.subject import columns, fit_marker_subject, sequence_both_ways, split_people
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solving.trajectory.sequence import fit_sequence


def test_a_limb_leaves_a_worse_minimum_from_the_other_direction_of_time(data_dir):
    """A break dancer's arm: fitted forwards, it stays 100 frames in a worse minimum, its markers 7 cm off."""
    path = data_dir("markers") / "mocaprecovery" / "data__85_12.c3d"
    (markers,) = split_people(read_markers(path)).values()
    markers = replace(markers, positions=markers.positions[2550:2800], residual=None)
    subject = fit_marker_subject(load_body("humanoid"), markers)
    body, points, sigma = subject.body, subject.points, subject.sigma
    x, given = columns(markers, points.names), {"sigma": sigma, "loss": MARKER_LOSS, "posture": 1.0}
    roots, angles = sequence_both_ways(body, points, x, sigma)
    ahead = fit_sequence(body, BodyState(roots[0], angles[0]), points, x, **given)
    back = fit_sequence(body, ahead.last, points, x[::-1], **given)
    costs = np.array([fit_sequence(body, BodyState(T, q), points, x[[f]], **given).costs[0]
                      for f, (T, q) in enumerate(zip(roots, angles))])  # fmt: skip
    alone = np.array([ahead.costs, back.costs[::-1]])
    assert (costs < alone.min(axis=0) + 1.5).all()
    assert (costs < alone[0] - 10.0).sum() > 50 and (costs < alone[1] - 1.0).any()
