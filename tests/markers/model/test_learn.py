from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies.marker_sets import load_marker_set
from kinefit.errors import ExportError, FileError, ObservationError
from kinefit.geometry.se3 import exp_so3
from kinefit.markers.model.from_frame import model_from_frame
from kinefit.markers.model.learn import learn_model, training_gate
from kinefit.markers.model.model import load_model, save_model
from kinefit.markers.model.rigid import fit_joint_few, reference_turn
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers

SET = load_marker_set("PAPER_44")


def moving(frames=80, *, held=(), noise=0.0, seed=0, turn=0.9):
    """The paper's body, every joint turned at random about its place but those held; positions and the true tree."""
    rng = np.random.default_rng(seed)
    joints = np.array([np.zeros(3) if s.joint is None else s.joint for s in SET.segments])
    places = np.zeros((frames, len(SET.labels), 3))
    for f in range(frames):
        Ts = []
        for s, segment in enumerate(SET.segments):
            R = exp_so3(turn * rng.standard_normal(3) if segment.name not in held else np.zeros(3))
            Rp, tp = Ts[segment.parent] if s else (np.eye(3), rng.uniform(-1, 1, 3))
            Ts.append((Rp @ R, Rp @ joints[s] + tp - Rp @ R @ joints[s]))
            for m in segment.markers:
                i = SET.labels.index(m)
                if not places[f, i].any():
                    places[f, i] = Ts[s][0] @ SET.places[i] + Ts[s][1]
    return Markers(SET.labels, 100.0, places + noise * rng.standard_normal(places.shape))


def sets_of(model):
    return {frozenset(model.labels[m] for m in s) for s in model.segments}


def test_a_template_is_filled_with_what_the_take_shows():
    model = learn_model(moving(), template=SET)
    assert sets_of(model) == {frozenset(s.markers) for s in SET.segments} and model.names[0] == "trunk"
    distance = np.linalg.norm(SET.places[:, None] - SET.places, axis=-1)
    for s in model.segments:
        i = np.ix_(s, s)
        np.testing.assert_allclose(model.mean[i], distance[i], atol=1e-9)
        x = model.reference[list(s)]
        np.testing.assert_allclose(np.linalg.norm(x[:, None] - x, axis=-1), distance[i], atol=1e-4)
        assert model.deviation[i].max() < 0.003
    assert all(j.marker is not None and j.exercised > 1.5 and j.spread < 0.002 for j in model.joints)


def test_segments_are_found_from_motion_alone():
    model = learn_model(moving(160, noise=0.002), template="")
    assert sets_of(model) == {frozenset(s.markers) for s in SET.segments}
    assert {model.labels[m] for m in model.segments[0]} == set(SET.segments[0].markers)
    true = {frozenset((s.markers, SET.segments[s.parent].markers)) for s in SET.segments[1:]}
    own = [tuple(sorted(model.labels[m] for m in s)) for s in model.segments]
    found = {frozenset((own[j.parent], own[j.child])) for j in model.joints}
    assert found == {frozenset(tuple(sorted(m)) for m in pair) for pair in true}


def test_a_virtual_joint_is_found_where_the_segments_meet():
    hidden = ("r_hip", "l_hip")
    take = moving(120, noise=0.001)
    keep = [i for i, n in enumerate(take.names) if n not in hidden]
    take = replace(take, names=tuple(take.names[i] for i in keep), positions=take.positions[:, keep])
    model = learn_model(take, template=SET)
    for joint in model.joints:
        if model.names[joint.child].startswith("thigh"):
            assert joint.marker is None and joint.spread < 0.01
            for s, place in ((joint.parent, joint.in_parent), (joint.child, joint.in_child)):
                side = model.names[joint.child][-1]
                true = SET.places[SET.labels.index(f"{side}_hip")]
                for m in model.segments[s]:
                    should = np.linalg.norm(SET.places[SET.labels.index(model.labels[m])] - true)
                    assert np.linalg.norm(model.reference[m] - place) == pytest.approx(should, abs=0.005)


def test_joints_held_still_do_not_merge_and_do_not_promise():
    held = ("forearm_r", "foot_l")
    take = moving(held=held)
    model = learn_model(take, template=SET)
    loose = learn_model(moving(), template=SET)
    assert sets_of(model) == sets_of(loose)
    i, j = model.labels.index("r_biceps"), model.labels.index("r_ulna")
    assert model.high[i, j] - model.low[i, j] > 0.1  # though training showed one distance only
    assert model.deviation[i, j] > 0.03
    told = {f.name for f in training_gate(take, model, marker_set=SET) if f.kind == "still"}
    assert told == set(held)
    assert not [f for f in training_gate(moving(), loose, marker_set=SET) if f.kind == "still"]
    stiff = moving(10, turn=0.0)
    alone = learn_model(stiff, template="")  # what was held still is one segment by its distances, but none of a body
    assert max(alone.mean[np.ix_(s, s)].max() for s in alone.segments) <= 0.6
    assert len([f for f in training_gate(stiff, alone) if f.kind == "still"]) == len(alone.joints)


def test_markers_whose_distance_varies_are_of_no_segment_and_a_set_is_asked_for():
    take = moving(160, noise=0.002)
    other = replace(take, names=tuple(f"M{i}" for i in range(len(take.names))))
    model = learn_model(other)
    assert max(model.deviation[np.ix_(s, s)].max() for s in model.segments) < 0.015
    told = training_gate(other, model)
    assert told[0].kind == "unknown" and "kinefit markers set" in told[0].remedy
    assert not [f for f in training_gate(take, model, marker_set=SET) if f.kind == "unknown"]


def test_a_label_that_the_file_has_twice_is_told():
    take = moving()
    first = take.names[0]
    again = replace(take, names=(*take.names, f"{first}_2"), positions=np.concatenate(
        [take.positions, take.positions[:, :1] + 0.3], axis=1))  # fmt: skip
    told = [f for f in training_gate(again, learn_model(again, template=SET)) if f.kind == "twice"]
    assert [f.name for f in told] == [f"{first}_2"] and f"label {first} twice" in str(told[0])
    assert not [f for f in training_gate(take, learn_model(take, template=SET)) if f.kind == "twice"]


def test_one_frame_gives_the_model_of_its_distances_wherever_it_stands():
    R, t = exp_so3(np.array([0.3, -1.0, 0.5])), np.array([5.0, 2.0, -3.0])
    model = model_from_frame(SET.places @ R.T + t, SET.labels, SET)
    assert sets_of(model) == {frozenset(s.markers) for s in SET.segments}
    np.testing.assert_allclose(model.mean, np.linalg.norm(SET.places[:, None] - SET.places, axis=-1), atol=1e-9)
    take = moving(40, turn=2.0)
    d = np.linalg.norm(take.positions[:, :, None] - take.positions[:, None], axis=-1)
    order = [take.names.index(n) for n in model.labels]
    d = d[:, order][:, :, order]
    assert (d > model.low - 1e-6).all() and (d < model.high + 1e-6).all()  # whatever the pose


def test_virtual_joints_of_one_frame_lie_where_the_set_says():
    cmu = load_marker_set("CMU_41")
    R, t = exp_so3(np.array([0.0, 1.2, 0.4])), np.array([1.0, 2.0, 3.0])
    model = model_from_frame(1.1 * cmu.places @ R.T + t, cmu.labels, cmu)
    joints = {s.name: 1.1 * R @ s.joint + t for s in cmu.segments if s.joint is not None}
    for joint in model.joints:
        if joint.marker is None:
            np.testing.assert_allclose(joint.in_parent, joints[model.names[joint.child]], atol=1e-3)


def test_what_does_not_fit_is_said():
    with pytest.raises(ObservationError, match="knows 0 of"):
        model_from_frame(np.eye(3).repeat(2, 0), list("abcdef"), SET)
    with pytest.raises(ObservationError, match="shape"):
        model_from_frame(np.zeros((3, 3)), SET.labels, SET)
    with pytest.raises(ObservationError, match="twice"):
        model_from_frame(SET.places, (*SET.labels[:-1], SET.labels[0]), SET)
    take = moving(5)
    with pytest.raises(ObservationError, match="are visible"):
        learn_model(replace(take, positions=np.full_like(take.positions, np.nan)))
    with pytest.raises(ObservationError, match="knows"):
        learn_model(take, template="CMU_41")


def test_a_marker_never_seen_is_a_gap_and_unlabelled_ones_are_left_out():
    take = moving(40)
    positions = np.array(take.positions)
    positions[:, 3] = np.nan
    take = Markers(("*1", *take.names[1:]), 100.0, positions)
    model = learn_model(take, template=SET)
    assert model.gaps == (take.names[3],) and len(model) == 42 and "*1" not in model.labels


def test_a_hinge_is_learnt_with_its_axis_and_limits():
    rng, full = np.random.default_rng(0), 1.5
    Rp = exp_so3(rng.standard_normal((300, 3)))
    turns = rng.uniform(-0.8, 0.4, 300)[:, None] * [0.0, 1.0, 0.0] + 0.02 * rng.standard_normal((300, 3))
    usual = exp_so3(np.array([0.3, 0.0, 0.0]))
    middle, give = reference_turn(Rp, Rp @ usual @ exp_so3(turns), np.ones(300, bool), full)
    np.testing.assert_allclose(middle, usual @ exp_so3(np.array([0.0, -0.2, 0.0])), atol=0.05)
    spread = np.sqrt(np.linalg.eigvalsh(give))
    assert abs(np.linalg.eigh(give)[1][:, 2] @ [0, 1, 0]) > 0.95  # the axis it turns about
    assert spread[2] < 0.8 and spread[1] < full / 3  # what else it may turn about is not known, but it bends one way
    still, loose = reference_turn(Rp, Rp @ usual, np.ones(300, bool), full)
    np.testing.assert_allclose(still, usual, atol=1e-9)
    assert np.sqrt(np.linalg.eigvalsh(loose)[0]) > full  # held still: any turn may be
    assert reference_turn(Rp, Rp, np.zeros(300, bool), full) == (None, None)


def test_a_marker_on_its_joint_does_not_spoil_it():
    rng = np.random.default_rng(1)
    x = rng.uniform(-0.2, 0.2, (2, 3))
    Rp, tp = exp_so3(rng.standard_normal((30, 3))), rng.standard_normal((30, 3))
    y = np.einsum("fij,kj->fki", Rp, x) + tp[:, None]
    a, b = fit_joint_few(Rp, tp, x, y, x[0])
    assert np.isfinite(a).all() and np.isfinite(b).all()


def test_a_model_comes_back_from_its_file(tmp_path):
    model = learn_model(moving(50, held=("head",)), template=SET, name="Anna")
    save_model(model, tmp_path / "anna.json")
    back = load_model(tmp_path / "anna.json")
    for key in ("mean", "deviation", "low", "high", "reference"):
        np.testing.assert_allclose(getattr(back, key), getattr(model, key), atol=1e-6)
    assert (back.name, back.labels, back.segments, back.names, back.gaps) == (
        model.name, model.labels, model.segments, model.names, model.gaps)
    assert [(j.parent, j.child, j.marker, j.ranges) for j in back.joints] == [
        (j.parent, j.child, j.marker, j.ranges) for j in model.joints]
    for mine, theirs in zip(back.joints, model.joints):
        np.testing.assert_allclose(mine.turn, theirs.turn, atol=3e-6)
        np.testing.assert_allclose(mine.give, theirs.give, atol=1e-6)
    with pytest.raises(ExportError, match="cannot be written"):
        save_model(model, tmp_path / "anna.json" / "anna.json")
    assert [f.name for f in tmp_path.iterdir()] == ["anna.json"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"kinefit marker model 1"', '"other"', "format"),
        ('"segments"', '"sgments"', "not a marker model"),
        ('"parent": 0', '"parent": 44', "parents come before"),
        ('"reference": [', '"reference": [[0, 0, 0],', "reference"),
        ('"mean": [', '"mean": [[1.0],', "distances.mean"),
        ('"format"', 'format"', "not valid JSON"),
    ],
)
def test_a_damaged_file_says_what_is_wrong(tmp_path, old, new, said):
    file = tmp_path / "m.json"
    save_model(model_from_frame(SET.places, SET.labels, SET), file)
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(FileError, match=said):
        load_model(file)


def test_a_real_take_tells_the_body_from_motion_alone(data_dir):
    take = read_markers(data_dir("markers") / "mocaprecovery" / "data__85_12.c3d")
    model = learn_model(replace(take, positions=take.positions[::12], residual=None), template="")
    found = [{model.labels[m].partition(":")[2] for m in s} for s in model.segments]
    assert {"LFHD", "RFHD", "LBHD", "RBHD"} in found and {"LFWT", "RFWT", "LBWT", "RBWT"} in found
    assert {"CLAV", "STRN", "C7", "T10"} <= found[0]
    assert any({"RFRM", "RWRA", "RWRB"} <= s and "RUPA" not in s for s in found)
