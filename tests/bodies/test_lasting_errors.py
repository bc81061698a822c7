"""Errors that frames have in common: the deviation of a difference is that of drawn errors."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies.lasting_errors import LastingErrors, ParameterErrors, common
from kinefit.bodies.motion import BRIEF_S

FRAMES, RATE, TAU = 60, 60.0, 0.25
KNEE = 20


def errors(constant=0.05, drift=0.03, keys=(0, 3, 30, 59), seed=0):
    """Factors of smooth size over the frames, of 47 coordinates in three and two directions."""
    random, keys = np.random.default_rng(seed), np.array(keys)
    of = lambda size, k: size * random.standard_normal((47, k)) * (1.0 + 0.02 * keys)[:, None, None]
    return LastingErrors(keys, of(constant, 3), of(drift, 2), TAU)


@pytest.fixture(scope="module")
def motion():
    made = smooth_motion(FRAMES, RATE)
    lasting = errors()
    s, d = (np.stack([lasting.at(np.full(47, f), np.arange(47))[k] for f in range(FRAMES)]) for k in (0, 1))
    std = np.sqrt(np.square(s).sum(axis=-1) + np.square(d).sum(axis=-1) + 0.01**2)
    return replace(made, dof_std=std, lasting=lasting)


def drawn(motion, random, count):
    """(count, F, 2) errors of two coordinates, as the model says."""
    frames = np.arange(FRAMES)
    apart = np.abs(motion.times[:, None] - motion.times) / np.array([[[TAU]], [[BRIEF_S]]])
    slow, brief = np.linalg.cholesky(np.exp(-apart) + 1e-10 * np.eye(FRAMES))
    a, b = random.standard_normal((count, 3)), slow @ random.standard_normal((2, FRAMES, count))
    out = []
    for coordinate in (KNEE, KNEE + 1):
        s, d = motion.lasting.at(frames, np.full(FRAMES, coordinate))
        white = brief @ random.standard_normal((FRAMES, count))
        out.append(a @ s.T + np.einsum("fk,kfc->cf", d, b) + 0.01 * white.T)
    return np.stack(out, axis=-1)


@pytest.mark.parametrize(
    ("frames", "coordinates", "weights"),
    [
        ((10, 50), (0, 0), (1, -1)),
        ((10, 16), (0, 0), (1, -1)),
        ((10, 50, 12, 40), (0, 0, 1, 1), (1, -1, -1, 1)),
        (tuple(range(5, 55)), (1,) * 50, (0.02,) * 50),
    ],
)
def test_sums_of_frames_vary_as_errors_that_are_drawn(motion, frames, coordinates, weights):
    errors = drawn(motion, np.random.default_rng(1), 4000)
    found = np.std(errors[:, list(frames), list(coordinates)] @ np.array(weights))
    told = motion.std_of(frames, np.array(coordinates) + KNEE, weights)
    assert told == pytest.approx(found, rel=0.05)


def test_one_frame_has_the_deviation_of_the_motion_and_a_constant_leaves_a_difference(motion):
    assert motion.std_of([7], [KNEE], [1.0]) == pytest.approx(motion.dof_std[7, KNEE])
    same = LastingErrors(np.array([0]), np.full((1, 47, 1), 0.2), np.zeros((1, 47, 1)), TAU)
    constant = replace(motion, dof_std=np.full((FRAMES, 47), 0.2), lasting=same)
    assert constant.std_of([7, 50], [KNEE, KNEE], [1, -1]) == pytest.approx(0.0, abs=1e-9)
    unknown = replace(constant, lasting=None)
    assert unknown.std_of([7, 50], [KNEE, KNEE], [1, -1]) == pytest.approx(0.2 * 2**0.5)
    blind = np.array(motion.dof_std)
    blind[50, KNEE] = np.inf
    assert replace(motion, dof_std=blind).std_of([7, 50], [KNEE, KNEE], [1, -1]) == np.inf


def test_parts_and_other_worlds_keep_them(motion):
    for start, part in zip((0, 25, 50), motion.parts(25)):
        weights = (1, -1)
        for first, last in ((0, 9), (3, 7)):
            whole = motion.std_of((start + first, start + last), (KNEE, KNEE), weights)
            assert part.std_of((first, last), (KNEE, KNEE), weights) == pytest.approx(whole)
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # x becomes y
    moved = motion.moved(T)
    for old, new in ((0, 1), (3, 4), (KNEE, KNEE)):
        told = moved.std_of((5, 50), (new, new), (1, -1))
        assert told == pytest.approx(motion.std_of((5, 50), (old, old), (1, -1)))


PARAMETERS = 5


def fit_of_a_take(random, prior, measured):
    """Covariance of a take's fit, its factor, and what turns measurements' whitened errors into estimates."""
    covariance = np.linalg.inv(prior + measured.T @ measured)
    return covariance, np.linalg.cholesky(covariance), random.standard_normal((3, PARAMETERS))


def lasting_of(factor, values, covariance, prior, moves, names="abcde"):
    known = ParameterErrors(tuple(names), values, covariance, prior, factor.T)
    return LastingErrors(np.array([0]), (moves @ factor)[None], np.zeros((1, 3, 0)), TAU, known)


def test_two_takes_share_the_errors_that_the_prior_leaves():
    random, count = np.random.default_rng(4), 40_000
    root = random.standard_normal((PARAMETERS, PARAMETERS)) + 2.0 * np.eye(PARAMETERS)
    prior = root @ root.T
    theta = np.linalg.solve(root.T, random.standard_normal((PARAMETERS, count)))  # prior mean: 0
    takes, errors = [], []
    for rows in (2, 3):  # of measurements that leave directions to the prior
        measured = 3.0 * random.standard_normal((rows, PARAMETERS))
        covariance, factor, moves = fit_of_a_take(random, prior, measured)
        estimate = covariance @ measured.T @ (measured @ theta + random.standard_normal((rows, count)))
        takes.append((factor, estimate, covariance, moves))
        errors.append(moves @ (estimate - theta))
    a, b = (lasting_of(f, e[:, 0], c, prior, m) for f, e, c, m in takes)
    told = a.constant[0] @ common(a, b) @ b.constant[0].T
    drawn = errors[0] @ errors[1].T / count
    np.testing.assert_allclose(told, drawn, atol=0.03 * np.abs(drawn).max())
    assert np.abs(drawn).max() > 0.2 * np.abs(errors[0] @ errors[0].T / count).max()
    of_one = [
        lasting_of(f, e[:, k], c, prior, m).parameters for k in range(200) for f, e, c, m in takes
    ]  # fmt: skip
    assert 0.5 < np.mean([one.misfit(other) for one, other in zip(of_one[::2], of_one[1::2])]) < 1.1


def test_takes_of_two_people_and_other_cameras_share_nothing():
    random = np.random.default_rng(5)
    prior, measured = np.eye(PARAMETERS), 20.0 * random.standard_normal((PARAMETERS, PARAMETERS))
    covariance, factor, moves = fit_of_a_take(random, prior, measured)
    of = lambda values, names="abcde": lasting_of(factor, values, covariance, prior, moves, names)
    someone = random.standard_normal(PARAMETERS)
    assert common(of(someone), of(someone)) is not None
    assert common(of(someone), of(random.standard_normal(PARAMETERS))) is None
    assert common(of(someone), of(someone, "vwxyz")) is None
    assert common(of(someone), replace(of(someone), parameters=None)) is None
    part = common(of(someone), of(someone, "abxyz"))
    assert np.trace(part) < np.trace(common(of(someone), of(someone)))
