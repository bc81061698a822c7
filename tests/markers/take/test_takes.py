"""Whole takes: trajectories that break, swap and vanish; ghosts; what is filled, and what is doubted."""

import numpy as np
import pytest
from benchmarks.scenes.marker_takes import CASES, broken, load, shares, training, truth_of

from kinefit.bodies.marker_sets import placement
from kinefit.errors import ObservationError
from kinefit.markers.frame.tables import Identification
from kinefit.markers.model.learn import learn_model
from kinefit.markers.take.consistency import Consistency, fill_gaps, gaps_of
from kinefit.markers.take.naming import Votes, assign_pieces, find_pieces
from kinefit.markers.take.takes import TakeSettings, identify_people, identify_take, one_after_the_other
from kinefit.observations import Markers
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="module")
def labelled():
    """Two seconds of a person with 41 markers, at 60 Hz."""
    motion = squat_and_wave(rate=60)
    points = placement(motion.body, "CMU_41").points
    return Markers(points.names, 60.0, motion.positions(points), up="z")


@pytest.fixture(scope="module")
def model(labelled):
    return learn_model(labelled, name="Anna")


def truthful(model, labelled, wrong=()):
    """Stands for `identify`: knows each point by where it is; in some frames exchanges two labels."""
    truth = truth_of(labelled, model.labels)
    calls = []

    def identify_frame(_, points, beliefs):
        d = np.linalg.norm(truth[:, :, None] - points, axis=-1)  # (F, M, N)
        frame = int(np.argmin(np.nansum(np.sort(np.nanmin(d, axis=2), axis=1)[:, :20], axis=1)))
        near = np.nanmin(d[frame], axis=1) < 1e-9
        guess = np.where(near, np.nanargmin(d[frame], axis=1), -1)
        if len(calls) in wrong:
            guess[[0, 5]] = guess[[5, 0]]
        calls.append(frame)
        return Identification(guess, np.where(near, 0.99, 0.0), 0.0, False, guess=guess)

    return identify_frame


def check(found, cut, labelled, model):
    """Shares of the seen labels that have the right name, and a wrong one."""
    return shares(found.column, cut, labelled, model.labels)


def test_a_broken_take_is_whole_again(labelled, model):
    cut = broken(labelled, 1, hidden=1.0, cut=2.0, swap=1.0, ghosts=3.0)
    assert cut.markers.positions.shape[1] > 60
    found = identify_take(model, cut.markers, identify_frame=truthful(model, labelled))
    right, wrong = check(found, cut, labelled, model)
    assert right > 0.999
    assert wrong == 0
    assert found.filled.any()
    off = np.linalg.norm(found.positions - truth_of(labelled, model.labels), axis=-1)
    assert np.nanmax(off[found.filled]) < 0.03
    assert np.nanmax(off[~found.filled]) == 0
    assert (found.confidence[found.column < 0] == 0).all()
    assert len(found.anchors) < 0.3 * len(labelled)


def test_single_frames_that_err_are_outvoted(labelled, model):
    cut = broken(labelled, 2)
    found = identify_take(model, cut.markers, identify_frame=truthful(model, labelled, wrong=(1, 4)))
    right, wrong = check(found, cut, labelled, model)
    assert right > 0.99
    assert wrong == 0


def test_columns_shuffled_in_every_frame(labelled, model):
    rng = np.random.default_rng(3)
    orders = [rng.permutation(len(labelled.names)) for _ in range(len(labelled))]
    positions = np.stack([x[o] for x, o in zip(labelled.positions, orders, strict=True)])
    found = identify_take(
        model, Markers(labelled.names, 60.0, positions), identify_frame=truthful(model, labelled),
        settings=TakeSettings(fill=0.0),
    )  # fmt: skip
    truth = truth_of(labelled, model.labels)
    assert np.nanmax(np.linalg.norm(found.positions - truth, axis=-1)) == 0
    assert np.isfinite(found.positions[..., 0]).mean() > 0.999


def test_another_subjects_model_is_told(labelled, model):
    def nothing(_, points, beliefs):
        return Identification(np.full(len(model), -1), np.zeros(len(model)), 0.0, False, guess=np.full(len(model), -1))

    asked = []
    with pytest.raises(ObservationError, match="does not fit the model of Anna: in . frames it finds 0 %.* least of"):
        identify_take(
            model, labelled, identify_frame=nothing, progress=lambda what, done, total: asked.append(done)
        )
    assert max(asked) <= 6  # refused after the trial


@pytest.mark.parametrize("seen", [0, 2])
def test_a_take_with_nothing_in_it(labelled, model, seen):
    positions = np.full((5, len(labelled.names), 3), np.nan)
    positions[:, :seen] = 1.0
    with pytest.raises(ObservationError, match="no frame shows three"):
        identify_take(model, Markers(labelled.names, 60.0, positions))


def test_doubts_name_the_frames_in_which_a_marker_leaves_its_segment(labelled, model):
    m = model.labels.index("LFHD")
    positions = np.array(labelled.positions)
    positions[60:90, labelled.names.index("LFHD")] += 0.06 * np.sin(np.linspace(0, np.pi, 30))[:, None]
    moved = Markers(labelled.names, 60.0, positions)
    found = identify_take(model, moved, identify_frame=truthful(model, moved))
    assert found.doubts
    assert found.doubts[0].label == "LFHD"
    assert 60 <= found.doubts[0].first <= found.doubts[0].last < 90
    assert found.confidence[75, m] < 0.9 < found.confidence[30, m]
    assert list(found.doubts) == sorted(found.doubts, key=lambda d: d.confidence)


def test_two_people_in_one_take(labelled, model):
    away = Markers(labelled.names, 60.0, 1.1 * labelled.positions + (0.0, 2.0, 0.0))  # taller
    both = np.concatenate([labelled.positions, away.positions], axis=1)
    count = len(labelled.names)
    names = tuple(f"*{i}" for i in range(2 * count))
    other = learn_model(away, name="Bob")
    first, second = identify_people([model, other], Markers(names, 60.0, both), settings=TakeSettings(every=0.6))
    mine = np.where(first.column >= 0, first.column // count, second.column // count)
    assert (mine == 0).mean() > 0.98
    assert not (first.column[..., None] == second.column[:, None])[first.column >= 0].any()
    with pytest.raises(ObservationError, match="Anna, Anna"):
        identify_people([model, model], labelled)


def test_takes_one_after_the_other():
    a = Markers(("A", "B"), 10.0, np.zeros((2, 2, 3)))
    b = Markers(("B", "C"), 10.0, np.ones((3, 2, 3)))
    both = one_after_the_other([a, b])
    assert both.names == ("A", "B", "C")
    assert np.isfinite(both.positions[..., 0]).tolist() == [[True, True, False]] * 2 + [[False, True, True]] * 3
    with pytest.raises(ObservationError, match="no take"):
        one_after_the_other([])


def test_pieces_end_where_a_column_jumps_and_go_on_in_another():
    t = np.arange(40)[:, None] / 100
    a, b = np.hstack([t, 0 * t, 0 * t]), np.hstack([t, 0 * t + 0.2, 0 * t])
    positions = np.stack([a, b], axis=1)
    positions[20:] = positions[20:, ::-1]  # the columns change places
    positions[30, 0] = np.nan
    pieces = find_pieces(positions, 100.0)
    rows = pieces.rows()
    assert sorted(len(r) for r in rows) == [9, 30, 40]
    assert all(len(np.unique(pieces.points[r, 1])) == 1 for r in rows)  # one marker each


def test_a_change_of_votes_within_a_piece_is_found_and_no_label_is_twice():
    positions = np.zeros((30, 2, 3))
    positions[:, 1] = 1.0
    pieces = find_pieces(positions, 100.0)
    votes = Votes(2)
    for f in range(0, 30, 3):
        guess = np.array([0, 1]) if f < 15 else np.array([1, 0])
        votes.add(pieces, f, Identification(guess, np.full(2, 0.95), 0.0, False, guess=guess))
    assert {(pieces.frame[a], pieces.frame[b]) for _, a, b in votes.changes(pieces)} == {(12, 15)}
    label = assign_pieces(np.array([[9.0, 1.0, 0.0], [8.0, 5.0, 0.0]]), pieces, pieces.rows())
    assert label.tolist() == [0, -1]
    assert assign_pieces(np.array([[5.0, 4.9, 0.0], [0.0, 0.5, 0.0]]), pieces, pieces.rows()).tolist() == [-1, -1]


def test_gaps_are_filled_with_the_segment_and_long_ones_stay(labelled, model):
    truth = truth_of(labelled, model.labels)
    cut = truth.copy()
    head, wrist = model.labels.index("LFHD"), model.labels.index("LWRA")
    cut[20:45, head] = np.nan
    cut[60:110, head] = np.nan
    cut[40:44, wrist] = np.nan
    cut[:3, wrist] = np.nan
    at, filled = fill_gaps(model, cut, 60.0)
    assert filled[20:45, head].all()
    assert not filled[60:110, head].any()
    assert filled[40:44, wrist].all()
    assert not filled[:3].any()
    assert np.linalg.norm(at - truth, axis=-1)[filled].max() < 0.005
    assert gaps_of(np.array([0, 1, 0, 0, 1, 0], bool)) == [(2, 3)]


def test_distances_know_a_label_from_its_neighbour(labelled, model):
    truth = truth_of(labelled, model.labels)
    agree = Consistency(model)
    own = agree.own(truth)
    assert np.nanmax(own) < 3
    z = agree.misfits(truth[:, 0], truth)
    assert (np.nanargmin(z, axis=1) == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["walk", "squats to jump", "clusters 61"])
def test_real_takes(data_dir, name):
    data_dir("markers")
    case = next(c for c in CASES if c.name == name)
    take = load(case.test)
    model = learn_model(training(case))
    cut = broken(take, 5)
    found = identify_take(model, cut.markers)
    right, wrong = check(found, cut, take, model)
    assert right > 0.998 and wrong < 0.002
