"""Masses of segments: sums, shares, centres, and what the person's size and mass change."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.body import Body
from kinefit.bodies.masses import TABLES, segment_masses
from kinefit.bodies.serial import body_from_arrays, body_to_arrays
from kinefit.bodies.toml.bodies import parse_body
from kinefit.errors import BodyError

BODY = load_body("humanoid")


def share(body: Body, *segments: str, table: str = "de_leva") -> float:
    found = segment_masses(body, table).masses
    return float(sum(found[body.tree.segments.index(s)] for s in segments) / found.sum())


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("name", ["humanoid", "humanoid10", "humanoid_hands", "golfer"])
def test_masses_add_up_to_the_mass_given_and_are_the_same_on_both_sides(name, table):
    body = replace(load_body(name), mass=32.0)
    found = segment_masses(body, table)
    assert found.masses.sum() == pytest.approx(32.0) and found.std == 0.0
    for s, segment in enumerate(body.tree.segments):
        if segment.endswith("_r"):
            assert found.masses[s] == pytest.approx(found.masses[body.tree.segments.index(f"{segment[:-1]}l")])
    gear = body.gear_scale[body.segment_scale]
    assert np.all(found.masses[gear] == 0.0)


def test_shares_are_those_of_the_tables():
    assert share(BODY, "thigh_r", table="de_leva_men") == pytest.approx(0.1416, rel=0.01)
    assert share(BODY, "thigh_r", table="de_leva_women") == pytest.approx(0.1478, rel=0.01)
    assert share(BODY, "thigh_r") == pytest.approx(0.1447, rel=0.01)
    assert share(BODY, "thigh_r", table="dempster") == pytest.approx(0.1, rel=0.02)
    assert share(BODY, "foot_r", "toes_r") == pytest.approx(0.0133, rel=0.02)


def test_the_centre_of_a_standing_adult_is_where_it_is_measured():
    found = segment_masses(BODY)
    at = found.masses @ (found.centres + BODY.tree.rest) / found.masses.sum()
    floor = BODY.points_rest(BODY.landmarks)[:, 1].min()
    assert 0.54 < (at[1] - floor) / BODY.stature < 0.58  # 55 to 57 %
    assert abs(at[2]) < 1e-9


def test_parts_that_the_table_lacks_leave_the_centre_of_the_whole_where_it_is():
    hands = load_body("humanoid_hands")
    fingers = [i for i, s in enumerate(hands.tree.segments) if s.endswith("_r") and s.split("_")[0] in
               ("hand", "thumb", "index", "middle", "ring", "little")]  # fmt: skip
    found, plain = segment_masses(hands), segment_masses(BODY)
    hand = BODY.tree.segments.index("hand_r")
    assert found.masses[fingers].sum() == pytest.approx(plain.masses[hand], rel=0.05)
    places = found.centres[fingers] + hands.tree.rest[fingers]
    centre = found.masses[fingers] @ places / found.masses[fingers].sum()
    wrist = hands.tree.rest[hands.tree.segments.index("hand_r")]
    assert np.linalg.norm(centre - wrist - plain.centres[hand]) < 0.02


def test_without_a_mass_it_follows_the_stature_with_its_error():
    child = BODY.scaled(np.full(len(BODY.scale_groups), 1.3 / 1.75))
    adult, small = segment_masses(BODY), segment_masses(child)
    assert adult.masses.sum() == pytest.approx(75.0, rel=0.01) and 0.1 < adult.std / 75.0 < 0.25
    assert 25.0 < small.masses.sum() < 33.0 and small.std < adult.std
    assert segment_masses(replace(BODY, stature=0.0)).masses.sum() == pytest.approx(75.0)


def test_longer_legs_and_thicker_ones_are_heavier():
    groups = np.array([1.1 if "thigh" in g or "shank" in g else 1.0 for g in BODY.scale_groups])
    long = BODY.scaled(groups)
    assert share(long, "thigh_r") > 1.01 * share(BODY, "thigh_r")
    s = BODY.tree.segments.index("thigh_r")
    wider = lambda c: replace(c, radii=tuple((1.1 * a, 1.1 * b) for a, b in c.radii))
    thick = replace(BODY, surfaces=tuple(wider(c) if c.segment == s else c for c in BODY.surfaces))
    assert share(thick, "thigh_r") > 1.1 * share(BODY, "thigh_r")


def test_an_arm_is_a_part_of_a_person_and_a_machine_is_filled_with_water():
    arm = segment_masses(replace(load_body("arm"), mass=75.0))
    assert arm.masses.sum() == pytest.approx(75.0 * (0.0263 + 0.015 + 0.0059), rel=0.02)
    names = tuple(f"part{k}" for k in range(len(BODY.tree.segments)))
    machine = replace(BODY, tree=replace(BODY.tree, segments=names))
    found = segment_masses(machine)
    assert 40.0 < found.masses.sum() < 120.0 and np.isinf(found.std)
    assert segment_masses(replace(machine, mass=10.0)).masses.sum() == pytest.approx(10.0)


def test_files_keep_the_mass_and_older_ones_have_none():
    body = replace(BODY, mass=32.0)
    arrays = body_to_arrays(body)
    assert body_from_arrays(arrays).mass == 32.0
    assert body_from_arrays({k: v for k, v in arrays.items() if k != "mass"}).mass == 0.0
    assert parse_body('[body]\nname = "anna"\nbase = "humanoid"\nmass = 32.0\n', "anna.toml").mass == 32.0


@pytest.mark.parametrize("mass", [-1.0, float("nan"), 1e9])
def test_a_number_that_is_no_mass_is_refused(mass):
    with pytest.raises(BodyError, match="mass"):
        parse_body(f'[body]\nname = "anna"\nbase = "humanoid"\nmass = {mass}\n', "anna.toml")


def test_an_unknown_table_is_refused_with_those_there_are():
    with pytest.raises(BodyError, match="dempster"):
        segment_masses(BODY, "winter2020")
