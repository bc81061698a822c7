"""A child's walk over two real plates: whose steps they measured, what is wrong with moved ones, and in files."""

import re
from dataclasses import replace

import ezc3d
import numpy as np
import pytest

from kinefit import load_body, read_markers, read_motion, write_motion
from kinefit.exporters import write_c3d, write_forces
from kinefit.exporters.gait.plates import by_plates, feet_on_plates, standing_mass, stood_on
from kinefit.exporters.report.feet import feet_alone, foot_events
from kinefit.readers.plates import read_force_file


def events_of(motion):
    feet = feet_alone(motion)
    return [(foot.contacts, foot.offs) for foot in (feet.left, feet.right)]


def footfalls(motion):
    return feet_on_plates(motion, events_of(motion), np.zeros(3))[0]


def findings_of(motion, events):
    return feet_on_plates(motion, events, np.zeros(3))[1]


def test_steps_are_those_of_the_plates(walk):
    right, left = footfalls(walk)
    assert (right.plate, right.side, left.plate, left.side) == ("plate 2", "right", "plate 1", "left")
    assert [right.contact, right.off] == pytest.approx([3.028, 3.643], abs=0.003)
    assert [left.contact, left.off] == pytest.approx([3.544, 4.173], abs=0.003)


def test_events_of_plates_replace_those_of_the_feet(walk):
    (left, _), steps = events_of(walk), footfalls(walk)
    times, stds = by_plates(steps, "left", "contact", left[0], np.full(len(left[0]), 0.01))
    assert len(times) == len(left[0]) and np.all(np.diff(times) > 0)
    assert stds.min() == pytest.approx(0.003) and np.sum(stds < 0.01) == 1
    assert np.min(np.abs(times - steps[1].contact)) == 0.0
    alone, _ = by_plates(steps, "left", "off", np.zeros(0), np.zeros(0))
    assert alone == pytest.approx([steps[1].off])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda p: p, ""),
        (lambda p: replace(p, corners=p.corners + [0.15, 0.1, 0.0]), "shifted by 1"),
        (lambda p: replace(p, moment=p.moment * [-1.0, -1.0, 1.0]), "turned by 180 degrees"),
        (lambda p: p.shifted(0.12), "clock is [+]0.12. ±"),
        (lambda p: replace(p, force=p.force / 4.448, moment=p.moment / 4.448), "not in newtons"),
    ],
)
def test_a_wrong_plate_is_named(walk, change, text):
    found = findings_of(replace(walk, plates=tuple(map(change, walk.plates))), events_of(walk))
    if not text:
        assert not found
        return
    assert found and all(f.remedy and f.confidence for f in found)
    assert any(re.search(text, f.text) for f in found)


def test_nothing_is_said_of_plates_without_feet_or_load(walk):
    empty = replace(walk, plates=tuple(replace(p, force=0.0 * p.force, moment=0.0 * p.moment) for p in walk.plates))
    assert not footfalls(empty) and not findings_of(empty, events_of(walk))
    assert not footfalls(replace(walk, plates=()))


def test_plates_go_with_the_motion(walk, tmp_path):
    write_motion(walk, tmp_path / "m.npz")
    back = read_motion(tmp_path / "m.npz")
    for a, b in zip(walk.plates, back.plates, strict=True):
        assert (a.name, a.rate, a.first_time) == (b.name, b.rate, b.first_time)
        np.testing.assert_array_equal(a.force, b.force)
        np.testing.assert_array_equal(a.corners, b.corners)
    turned = back.turned("y")
    np.testing.assert_allclose(turned.plates[0].load, walk.plates[0].load, atol=1e-9)
    assert turned.plates[0].normal @ [0.0, 1.0, 0.0] > 0.99


def test_c3d_has_the_plates(walk, tmp_path):
    write_c3d(walk, tmp_path / "m.c3d")
    for a, b in zip(walk.plates, read_markers(tmp_path / "m.c3d").plates, strict=True):
        np.testing.assert_allclose(a.force, b.force, atol=1e-3)
        np.testing.assert_allclose(a.moment, b.moment, atol=1e-4)
        np.testing.assert_allclose(a.times, b.times, atol=1e-9)
    others = ezc3d.c3d(str(tmp_path / "m.c3d"), extract_forceplat_data=True)["data"]["platform"]
    stood = walk.plates[0].load > 50.0
    found = 1e-3 * others[0]["center_of_pressure"].T[stood]
    np.testing.assert_allclose(found, walk.plates[0].centre_of_pressure()[stood], atol=1e-4)


def test_opensim_has_the_forces(walk, tmp_path):
    write_forces(walk, tmp_path / "forces.mot")
    for a, b in zip(walk.turned("y").plates, read_force_file(tmp_path / "forces.mot").plates, strict=True):
        stood = a.load > 50.0
        np.testing.assert_allclose(a.force[stood], b.force[stood], atol=1e-5)
        np.testing.assert_allclose(a.centre_of_pressure()[stood], b.centre_of_pressure()[stood], atol=1e-5)
        np.testing.assert_allclose(a.free_moment()[stood], b.free_moment()[stood], atol=1e-5)


def test_who_stands_on_plates_is_weighed(data_dir):
    folder = data_dir("gait_biomechzoo")
    for name, mass, stature in (("HC030A", 45.8, 1.48), ("HC044A", 39.4, 1.45)):
        body = replace(load_body("humanoid"), stature=stature)
        static, walk = (read_markers(folder / name / f"{trial}.c3d").plates for trial in ("static", "straight"))
        assert standing_mass([(), walk, static], body) == pytest.approx(mass, rel=0.02)
        assert standing_mass([walk], body) is None and standing_mass([], body) is None
        pounds = tuple(replace(p, force=p.force / 4.448) for p in static)
        assert standing_mass([pounds], body) is None


def halves(plate):
    """Two plates in place of one, which meet under the foot on it: first the one bears it, then the other."""
    loaded = plate.load > 50.0
    cop = (plate.centre_of_pressure()[loaded] - plate.centre) @ plate.axes.T
    along = int(np.argmax(np.ptp(cop, axis=0)))
    edge, ahead = np.median(cop[:, along]), np.sign(cop[-1, along] - cop[0, along])
    share = np.interp(plate.times, plate.times[loaded][[len(cop) // 3, 2 * len(cop) // 3]], [1.0, 0.0])[:, None]
    local, out = (plate.corners - plate.centre) @ plate.axes.T, []
    for name, part, side in (("heel", share, -ahead), ("ball", 1.0 - share, ahead)):
        mine = local.copy()
        inner = np.sign(mine[:, along]) != side
        mine[inner, along] = edge
        corners = plate.centre + mine @ plate.axes
        moment = plate.moment - np.cross(corners.mean(axis=0) - plate.centre, plate.force)
        out.append(replace(plate, name=name, corners=corners, force=part * plate.force, moment=part * moment))
    return out


@pytest.mark.parametrize("order", [1, -1])
def test_one_foot_on_two_plates_is_one_step(walk, order):
    whole = footfalls(walk)[0]
    plate = next(p for p in walk.plates if p.name == whole.plate)
    (found,) = footfalls(replace(walk, plates=tuple(halves(plate)[::order])))
    assert found.side == whole.side and set(found.plate.split(", ")) == {"heel", "ball"}
    assert [found.contact, found.off] == pytest.approx([whole.contact, whole.off], abs=0.005)


def test_half_a_foot_on_a_plate_is_no_step(walk):
    plate = next(p for p in walk.plates if p.name == footfalls(walk)[0].plate)
    assert [footfalls(replace(walk, plates=(half,))) for half in halves(plate)] == [[], []]


def test_events_of_a_late_clock_are_not_used(walk):
    late = replace(walk, plates=tuple(plate.shifted(0.3) for plate in walk.plates))
    alone, used = feet_alone(late), foot_events(late)
    np.testing.assert_array_equal(alone.left.contacts, used.left.contacts)
    assert foot_events(walk).left.contact_std.min() < alone.left.contact_std.min()


def test_a_plate_elsewhere_has_no_explanation(walk):
    rng = np.random.default_rng(0)
    moved = tuple(replace(p, moment=p.moment + rng.normal(scale=150.0, size=p.moment.shape)) for p in walk.plates)
    found = findings_of(replace(walk, plates=moved), events_of(walk))
    assert found and all("neither a shift nor a turn" in f.confidence for f in found)


def test_of_several_people_each_has_the_own_plates(walk):
    assert len(stood_on(walk, [])[0]) == 2
    beside = replace(walk, plates=tuple(replace(p, corners=p.corners + [1.5, 1.5, 0.0]) for p in walk.plates))
    assert not stood_on(beside, [])[0]


def test_forces_of_plates_with_clocks_of_their_own(walk, tmp_path):
    first, second = walk.plates
    other = second.at(np.arange(second.times[0], second.times[-1] + 0.4, 1.0 / 700.0))
    write_forces(replace(walk, plates=(first, other)), tmp_path / "forces.mot")
    found = read_force_file(tmp_path / "forces.mot").plates
    assert found[0].times[-1] >= second.times[-1] + 0.39
    stood = found[1].load > 100.0
    wanted = second.at(found[1].times)
    assert np.abs(found[1].load - wanted.load)[stood].max() < 40.0  # of 60 N/ms between samples of 700 Hz
