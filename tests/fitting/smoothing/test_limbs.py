"""Degrees of freedom that go together."""

from kinefit.bodies import load_body
from kinefit.fitting.smoothing.process_noise import limbs, noise_groups

BODY = load_body("humanoid")
TREE = BODY.tree


def test_degrees_of_freedom_are_grouped_by_name_and_by_limb():
    same = noise_groups(BODY)
    assert same[6 + TREE.coordinate("knee_angle_r")] == same[6 + TREE.coordinate("knee_angle_l")]
    assert len(set(same[:3])) == len(set(same[3:6])) == 1 and same[0] != same[3]
    limb = limbs(BODY)[6:]
    whole = ("hip_flexion_r", "mtp_angle_r"), ("clav_prot_l", "wrist_dev_l"), ("lumbar_extension", "thorax_bending")
    for together in whole:
        assert len({limb[TREE.coordinate(c)] for c in together}) == 1
    assert len(set(limb)) == 6  # trunk, head, two arms, two legs
