from dataclasses import replace

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.markers.audit.audit import audit_take
from kinefit.markers.audit.swaps import find_crossings, pair_gain, swap_gains
from kinefit.markers.model.learn import learn_model
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers


@pytest.fixture(scope="module")
def walk(data_dir):
    folder = data_dir("markers") / "momentum"
    return read_markers(folder / "momentum__examples__process_markers_app__02_01.c3d")


def exchanged(take, a, b, first, last):
    i, j = (take.names.index(f"TakeoMonday:{n}") for n in (a, b))
    positions = np.array(take.positions)
    span = slice(first, last + 1)
    positions[span, i], positions[span, j] = take.positions[span, j], take.positions[span, i]
    return replace(take, positions=positions, residual=None)


def wrong(found):
    return [f for f in found if f.kind in ("swapped", "throughout")]


def test_a_clean_take_raises_no_alarm(walk):
    assert audit_take(walk) == []


@pytest.mark.parametrize(
    ("a", "b", "first", "last"),
    [("LFHD", "RFHD", 40, 90), ("LKNE", "RKNE", 100, 250), ("RWRA", "RWRB", 0, 60), ("LFWT", "RBWT", 159, 272)],
)
def test_a_swap_is_found_with_its_frames(walk, a, b, first, last):
    found = wrong(audit_take(exchanged(walk, a, b, first, last)))
    assert len(found) == 1 and {n.partition(":")[2] for n in found[0].labels} == {a, b}
    assert (found[0].first, found[0].last) == (first, last) and "swapped" in str(found[0])


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize(("a", "b"), [("LFHD", "RFHD"), ("RWRA", "RELB"), ("LKNE", "LTHI")])
def test_an_exchange_of_one_frame_is_found_even_with_a_hidden_marker(walk, a, b, hidden):
    take = exchanged(walk, a, b, 120, 120)
    if hidden:
        positions = np.array(take.positions)
        positions[120, take.names.index(f"TakeoMonday:{b}")] = np.nan
        take = replace(take, positions=positions)
    found = wrong(audit_take(take))
    assert len(found) == 1 and {n.partition(":")[2] for n in found[0].labels} == {a, b}
    assert (found[0].first, found[0].last) == (120, 120)


@pytest.mark.parametrize("way", ["islands", "one island", "the other hidden", "at its end", "leaps into a gap"])
@pytest.mark.parametrize(("a", "b"), [("LFWT", "LBWT"), ("RKNE", "RSHN"), ("LELB", "LFRM"), ("LTOE", "LHEE")])
def test_an_exchange_of_one_frame_inside_a_gap_is_found(waving, way, a, b):
    i, j = waving.names.index(a), waving.names.index(b)
    x = np.array(waving.positions)
    if way != "leaps into a gap":
        x[90 if way != "at its end" else 120 : 140, i] = np.nan
    if way != "one island":
        x[95:130, j] = np.nan
    x[120, i] = waving.positions[120, j]
    x[120, j] = waving.positions[120, i] if way in ("islands", "one island") else np.nan
    found = wrong(audit_take(replace(waving, positions=x)))
    assert [(set(f.labels), f.first, f.last) for f in found] == [({a, b}, 120, 120)]


def test_islands_with_their_own_labels_raise_no_alarm(waving):
    rng, x = np.random.default_rng(1), np.array(waving.positions)
    x[30:100] = np.where(rng.random((70, x.shape[1], 1)) < 0.5, np.nan, x[30:100])
    assert wrong(audit_take(replace(waving, positions=x))) == []


def test_three_turned_round_are_found_as_exchanges_of_them(walk):
    take = exchanged(exchanged(walk, "RELB", "RFRM", 50, 150), "RFRM", "RWRA", 50, 150)
    found = wrong(audit_take(take))
    assert {n.partition(":")[2] for f in found for n in f.labels} == {"RELB", "RFRM", "RWRA"}
    assert len(found) == 2 and all((f.first, f.last) == (50, 150) for f in found)


def test_a_swap_of_all_frames_shows_against_the_subjects_model(walk):
    model = learn_model(walk)
    assert audit_take(walk, model=model) == []
    found = wrong(audit_take(exchanged(walk, "LTOE", "LMT5", 0, len(walk) - 1), model=model))
    assert [f.kind for f in found] == ["throughout"]
    assert set(found[0].labels) == {"TakeoMonday:LTOE", "TakeoMonday:LMT5"}


@pytest.mark.parametrize(("a", "b"), [("LTHI", "RTHI"), ("C7", "CLAV")])
def test_a_swap_of_all_frames_shows_by_what_moves_together_and_by_places(walk, a, b):
    found = wrong(audit_take(exchanged(walk, a, b, 0, len(walk) - 1)))
    assert [f.kind for f in found] == ["throughout"] and {n.partition(":")[2] for n in found[0].labels} == {a, b}


def test_a_marker_off_its_segment_is_a_stray_not_a_swap(walk):
    positions = np.array(walk.positions)
    positions[100:140, walk.names.index("TakeoMonday:RFHD")] += [0.0, 0.0, 0.15]
    found = audit_take(replace(walk, positions=positions, residual=None))
    assert [(f.kind, f.labels, f.first, f.last) for f in found] == [("stray", ("TakeoMonday:RFHD",), 100, 139)]


def test_real_errors_are_found(data_dir):
    take = read_markers(data_dir("markers_bmc_run") / "run" / "ExpData" / "motion_capture_run.trc")
    found = wrong(audit_take(take))  # two markers of a foot that change places every third frame
    assert found and all(set(f.labels) == {"RTOE", "RMT5"} for f in found)


@pytest.mark.parametrize("trial", ["walking1", "walkingTO1"])
def test_real_exchanges_at_the_ends_of_gaps_are_found(data_dir, trial):
    """A thigh's markers: 2 to 5 mm from the other's place, 53 to 111 mm from their own."""
    found = wrong(audit_take(read_markers(data_dir("forces_nimblephysics") / "subject4" / f"{trial}.trc")))
    spans = {frozenset(f.labels): (f.first, f.last) for f in found}
    right, left = frozenset({"r_thigh3", "r_thigh5"}), frozenset({"L_thigh2", "L_thigh4"})
    assert spans == ({right: (7, 10)} if trial == "walking1" else {right: (6, 14), left: (18, 22)})


@pytest.mark.parametrize(("file", "pairs"), [
    ("markers/btkdata/Input__C3DSamples__c3d.org__sample13__golfswing.c3d", []),  # a club passes a hand at 25 m/s
    ("markers_bmc_run/walk2.trc", [("L.MT1", "L.MT2")]),  # L.MT2 jumps by 35 mm beside the others of its foot
])
def test_labels_that_go_on_with_their_segments_did_not_change_places(data_dir, file, pairs):
    folder, _, rest = file.partition("/")
    assert [f.labels for f in wrong(audit_take(read_markers(data_dir(folder) / rest)))] == pairs


def test_another_subject_with_another_placing_has_no_wrong_names(data_dir):
    folder = data_dir("markers") / "nimblephysics"
    other = learn_model(read_markers(folder / "data__grf__Subject4__MarkerData__squats1.trc"))
    take = read_markers(folder / "data__osim__DetectMarkerFlip__squats1.trc")
    found = audit_take(replace(take, positions=take.positions[::12], residual=None), model=other)
    assert {f.kind for f in found} == {"elsewhere"}
    assert {f.labels[0] for f in found} == {"R_humerus", "L_humerus", "R_forearm", "L_forearm"}


def test_a_model_of_other_labels_is_refused(walk):
    model = learn_model(walk)
    with pytest.raises(ObservationError, match="knows 0 of the labels"):
        audit_take(Markers(("a", "b", "c"), 100.0, np.zeros((5, 3, 3))), model=model)


def test_gains_of_all_pairs_are_those_of_each():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(4, 6, 3))
    x[1, 2] = np.nan
    mean = np.linalg.norm(x[0][:, None] - x[0], axis=-1)
    deviation = np.full((6, 6), 0.3)
    gains = swap_gains(x, mean, deviation)
    for i in range(6):
        for j in range(i):
            np.testing.assert_allclose(gains[:, i, j], pair_gain(x, i, j, mean, deviation), atol=1e-3)


def test_crossings_are_where_two_go_on_as_the_other():
    t = np.linspace(0, 1, 50)[:, None]
    a, b = np.hstack([t, t * 0, t * 0]), np.hstack([t, t * 0 + 0.2, t * 0])
    x = np.stack([a, b], 1)
    x[20:30] = x[20:30, ::-1]
    found, broken = find_crossings(x)
    assert found == [(20, 0, 1), (30, 0, 1)] and broken[20].all() and not broken[10].any()
