"""Plates of treadmills, plates that two people or two feet load at once: right, or named and given to no foot."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.gait.belts import foot_forces, on_belt, plate_of

from kinefit.exporters.gait.files import step_forces
from kinefit.exporters.gait.plates import stood_on
from kinefit.exporters.gait.record import gait_record
from kinefit.exporters.report.feet import BELT_STD, footing
from kinefit.observations import Markers


@pytest.fixture(scope="module")
def treadmill(walk):
    """The walk on a belt, its velocity, its feet over the ground, their forces, and the middle between them."""
    motion, belt, feet = on_belt(walk)
    forces = [foot_forces(motion, foot) for foot in (feet.left, feet.right)]
    hips = motion.positions(motion.body.landmarks.select(("l_hip", "r_hip")))[..., :2]
    return motion, belt, feet, forces, hips


def halves(treadmill):
    """Plates of the left and of the right half of a split belt."""
    motion, _, _, forces, hips = treadmill
    left = (hips[:, 0] - hips[:, 1]).mean(axis=0)
    across = int(np.argmax(np.abs(left)))
    out = []
    for name, sign, part in zip(("left belt", "right belt"), (1.0, -1.0), forces):
        middle, half = hips.mean(axis=(0, 1)), np.full(2, 1.2)
        middle[across] += 0.3 * sign * np.sign(left[across])
        half[across] = 0.295
        out.append(plate_of(name, motion, middle, half, [part]))
    return tuple(out)


def test_a_split_belt_gives_each_foot_its_steps(treadmill):
    motion, belt, feet, _, _ = treadmill
    found = footing(replace(motion, plates=halves(treadmill)))
    assert not found.findings and [step.side for step in found.steps] == ["right", "left", "right", "left"]
    contacts = np.sort(np.concatenate([feet.left.contacts, feet.right.contacts]))
    assert [step.contact for step in found.steps] == pytest.approx(contacts, abs=0.003)
    assert {step.plate for step in found.steps} == {"left belt", "right belt"}
    assert found.feet.belt == pytest.approx([belt[0], -belt[1]], abs=2.0 * BELT_STD)


def test_one_plate_under_both_feet_of_a_treadmill_is_given_to_none(treadmill):
    motion, _, _, forces, hips = treadmill
    plate = plate_of("belt", motion, hips.mean(axis=(0, 1)), np.full(2, 1.2), forces)
    whole = replace(motion, plates=(plate,))
    (found,) = footing(whole).findings
    assert (found.severity, found.kind) == ("note", "plates")
    assert "belt is given to no foot from 3." in found.text and "both feet stand there" in found.text
    assert not footing(whole).steps and not step_forces(whole)
    assert footing(whole).feet.left.contacts == pytest.approx(footing(motion).feet.left.contacts)


def test_lengths_over_a_belt_of_known_speed_are_within_their_deviations(walk):
    numbers = {}
    for speed in (0.0, 0.7, 1.05, 1.4):
        motion = on_belt(walk, speed)[0] if speed else replace(walk, plates=(), events=())
        numbers[speed] = {name: (a, b) for name, a, b, _ in gait_record({"walk": motion}).compared("straight")}
    for speed in (0.7, 1.05, 1.4):
        for name in ("stride length [m]", "speed [m/s]", "step length [m]"):
            for found, true in zip(numbers[speed][name], numbers[0.0][name]):
                assert found.mean == pytest.approx(true.mean, abs=2.0 * found.std), (speed, name)
        assert 0.01 < numbers[speed]["stride length [m]"][0].std < 0.03


@pytest.fixture
def between(walk):
    """The walk's left step on its plate, and another person's step on it, so much later [s] and beside it [m]."""

    def made(later, beside, wider=0.0):
        step = next(step for step in footing(walk).steps if step.side == "left")
        plate = next(plate for plate in walk.plates if plate.name == step.plate)
        other = plate.shifted(later).at(plate.times)
        force, way = plate.force + other.force, beside * plate.axes[0]
        corners = plate.corners + wider * np.sign(plate.corners - plate.centre) * [1.0, 1.0, 0.0]
        moment = plate.moment + other.moment + np.cross(way, other.force)
        both = replace(plate, corners=corners, force=force, moment=moment)
        return replace(walk, plates=(both,)), both, way

    return made


@pytest.mark.parametrize(("later", "beside"), [(0.0, 0.3), (0.2, 0.3), (-0.3, 0.4), (0.4, 0.3), (0.5, 0.35)])
def test_a_plate_that_somebody_else_loads_too_gives_no_step(between, later, beside):
    shared, _, _ = between(later, beside)
    found = footing(shared)
    assert not found.steps and not step_forces(shared)
    (said,) = found.findings
    assert said.kind == "plates" and ("somebody or something else" in said.text or "nobody else" in said.confidence)


def test_of_several_people_who_load_a_plate_none_has_it(walk, between):
    shared, plate, way = between(0.0, 0.2)
    heel = walk.positions(walk.body.landmarks.select(("l_heel", "l_metatarsal_phalanx_1"))) + way
    other = Markers(("Bert:LHEE", "Bert:LTOE"), walk.rate, heel, first_time=float(walk.times[0]))
    plates, (said,) = stood_on(shared, [other])
    assert plates == () and said.severity == "note" and f"{plate.name} is assigned to no person" in said.text
    elsewhere = replace(other, positions=heel + np.array([2.0, 0.0, 0.0]))
    assert stood_on(shared, [elsewhere]) == ((shared.plates[0],), [])
    unseen = replace(other, positions=np.full_like(heel, np.nan))
    assert stood_on(shared, [unseen])[1] == []
