"""Which points of a body share a shift: left and right are alike."""

from kinefit.bodies import PointSet, load_body
from kinefit.solving.bundle.shape import mirror_points

BODY = load_body("humanoid")
SEGMENTS = ("trunk", "leg_r", "leg_l", "foot_r")


def shared(*points):
    segments = [SEGMENTS.index(s) for s, _ in points]
    return mirror_points(PointSet(tuple(map(str, range(len(points)))), segments, [x for _, x in points]), SEGMENTS)


def test_mirrored_points_of_two_limbs_share_a_shift():
    lead, sign = shared(
        ("leg_l", (0.1, 0.2, -0.03)), ("leg_r", (0.1, 0.2, 0.03)), ("leg_r", (0.0, 0.0, 0.0)), ("leg_l", (0, 0, 0))
    )
    assert list(lead) == [1, 1, 2, 2] and list(sign) == [-1, 1, 1, -1]


def test_points_of_the_trunk_share_across_its_middle():
    lead, sign = shared(("trunk", (0.0, 0.5, 0.1)), ("trunk", (0.0, 0.5, -0.1)), ("trunk", (0.1, 0.6, 0.0)))
    assert list(lead) == [0, 0, 2] and list(sign) == [1, -1, 0]


def test_a_point_without_a_partner_is_its_own():
    lead, sign = shared(
        ("leg_l", (0.1, 0.2, -0.03)), ("foot_r", (0.0, 0.1, 0.0)), ("trunk", (0, 0.5, 0.1)), ("trunk", (0, 0.4, -0.1))
    )
    assert list(lead) == [0, 1, 2, 3] and list(sign) == [1, 1, 1, 1]


def test_two_detectors_points_at_one_place_pair_in_order():
    spot_r, spot_l = ("leg_r", (0.1, 0.2, 0.03)), ("leg_l", (0.1, 0.2, -0.03))
    lead, sign = shared(spot_r, spot_l, spot_r, spot_l)
    assert list(lead) == [0, 0, 2, 2] and list(sign) == [1, -1, 1, -1]


def test_every_sided_keypoint_of_the_humanoid_has_its_partner():
    for name, points in BODY.keypoint_sets.items():
        lead, sign = mirror_points(points, BODY.tree.segments)
        for k, point in enumerate(points.names):
            left = "left" in point or (point[0] == "L" and point[1].isupper())
            assert (sign[k] == -1) == left, (name, point)
            assert sign[lead[k]] != -1
