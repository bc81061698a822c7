"""Standard deviations of joint centres that depend on coordinates that nothing observes."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.fitting.frame.results import deviations
from kinefit.solving.equations import joint_moves

BODY = load_body("humanoid")
TREE = BODY.tree
STATE = BODY.default_state(np.eye(4))
SEEN = "pelvis", "thigh_r", "thigh_l", "clavicle_r", "clavicle_l", "upperarm_r", "upperarm_l"
ELBOWS = "forearm_r", "forearm_l"


def posterior(segments, sigma=0.005):
    """Covariance of a pose whose joint centres of some segments are measured."""
    H = np.eye(6 + len(TREE.coordinates))
    H[6:, 6:] = TREE.posture_precision
    for moves in joint_moves(BODY, STATE)[[TREE.segment(s) for s in segments]]:
        H += moves.T @ moves / sigma**2
    return np.linalg.inv(H)


def observed_but(*names):
    observed = np.ones(len(TREE.coordinates), bool)
    observed[[TREE.coordinate(name) for name in names]] = False
    return observed


def deviations_of(C, observed):
    dofs, joints = deviations(BODY, joint_moves(BODY, STATE)[None], C[None], observed[None])
    return dofs[0], joints[0]


def joint_std(segment, *unobserved, segments=(*SEEN, *ELBOWS)):
    _, joints = deviations_of(posterior(segments), observed_but(*unobserved))
    return joints[TREE.segment(segment)]


@pytest.mark.parametrize("unobserved", ["thorax_extension", "lumbar_extension", "lumbar_rotation"])
@pytest.mark.parametrize("segment", ["clavicle_r", "upperarm_l", *ELBOWS])
def test_joints_that_are_measured_are_known_though_one_coordinate_above_them_is_not(segment, unobserved):
    """Only the sum of the spine's angles is measured: each alone is unknown, by 5 cm at the elbow."""
    C = posterior((*SEEN, *ELBOWS))
    dofs, _ = deviations_of(C, observed_but(unobserved))
    assert np.isinf(dofs[6 + TREE.coordinate(unobserved)])
    moves = joint_moves(BODY, STATE)[TREE.segment(segment)]
    fitted = np.sqrt(np.diag(moves @ C @ moves.T))
    std = joint_std(segment, unobserved)
    assert np.all(std < 0.012) and np.all(std >= fitted - 1e-12)


def test_a_turn_about_the_upper_arm_hardly_moves_the_elbow():
    """The elbow is 14 mm beside the axis."""
    assert np.isfinite(joint_std("forearm_r", "arm_rot_r")).all()


def test_a_hand_at_an_unobserved_elbow_is_unknown():
    free, segments = ("elbow_flex_r", "arm_rot_r"), (*SEEN, *ELBOWS, "hand_l")
    assert np.isinf(joint_std("hand_r", *free, segments=segments)).any()
    for segment in ("forearm_r", "hand_l"):
        assert np.isfinite(joint_std(segment, *free, segments=segments)).all()


def test_variances_of_unobserved_coordinates_are_those_of_the_prior():
    """What is coupled to nothing by measurements stays as it was."""
    C = posterior(SEEN)
    turn = TREE.coordinate("pro_sup_r")
    C[6 + turn] = C[:, 6 + turn] = 0.0
    C[6 + turn, 6 + turn] = 0.01
    with_prior = deviations_of(C, observed_but("pro_sup_r"))
    before = deviations_of(C, observed_but())
    assert np.isinf(with_prior[0][6 + turn]) and np.isfinite(before[0][6 + turn])
    known = [TREE.segment(s) for s in (*SEEN, *ELBOWS)]
    np.testing.assert_allclose(with_prior[1][known], before[1][known])
