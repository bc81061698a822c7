"""Region growing over a grid, its seeds, and the correlation that finds a start."""

import numpy as np
import pytest
from tests.images.photogrammetry import scenes

from kinefit.errors import ObservationError
from kinefit.images.photogrammetry._kernels_growing import pop, push
from kinefit.images.photogrammetry.least_squares_matching import Grid, Seeds, grow
from kinefit.images.photogrammetry.matching.multi_image import search_box
from kinefit.images.photogrammetry.seeding.unaided import sift_seeds
from kinefit.images.photogrammetry.spline_image import SplineImage

DEFORM = np.array([[1.08, 0.06], [-0.05, 0.94]])


@pytest.fixture(scope="module")
def stretched():
    return scenes.pair(size=(240, 180), move=(6.4, -3.2), deform=DEFORM, noise=2.0)


def goal(at):
    middle = np.array([120.0, 90.0])
    return (at - middle) @ DEFORM.T + middle + (6.4, -3.2)


def test_one_seed_reaches_all_of_the_grid(stretched):
    grid = Grid.of((240, 180), 8, margin=25)
    seed = Seeds.of([[120.0, 90.0]], [[126.0, 87.0]])
    found = grow(*stretched, grid, seed)
    assert found.found.mean() > 0.97
    np.testing.assert_allclose(found.uv[found.found], goal(grid.points[found.found]), atol=0.2)


def test_sift_finds_seeds_with_their_turn():
    turn = 0.6
    deform = 1.2 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    first, second = scenes.pair(size=(300, 300), deform=deform, grain=3.0)
    seeds = sift_seeds(first, second)
    assert len(seeds.first) >= 10
    np.testing.assert_allclose(np.median(seeds.deformation, axis=0), deform, atol=0.1)
    grid = Grid.of((300, 300), 10, margin=80)
    found = grow(first, second, grid, seeds, window=21)
    assert found.found.mean() > 0.95


def test_nothing_in_common_gives_no_seeds():
    first, _ = scenes.pair(seed=1)
    blank = SplineImage.of(np.full((120, 160), 50.0))
    assert len(sift_seeds(first, blank).first) == 0


def test_three_seeds_by_hand_give_the_deformation():
    at = np.array([[60.0, 60.0], [180.0, 70.0], [100.0, 130.0], [np.nan, 3.0]])
    seeds = Seeds.of(at, np.where(np.isfinite(at), goal(at), np.nan))
    np.testing.assert_allclose(seeds.deformation[0], DEFORM, atol=1e-9)
    assert len(seeds.first) == 3
    for wrong in ([], [[np.nan, 1.0]]):
        with pytest.raises(ObservationError):
            Seeds.of(np.reshape(wrong, (-1, 2)), np.reshape(wrong, (-1, 2)))


def test_a_mask_and_a_gap_leave_places_out(stretched):
    mask = np.zeros((180, 240), bool)
    mask[40:140, 40:200] = True
    mask[80:100, 100:120] = False
    grid = Grid.of((240, 180), 5, mask=mask)
    found = grow(*stretched, grid, Seeds.of([[60.0, 60.0]], goal(np.array([[60.0, 60.0]]))))
    assert not found.found[~grid.inside].any() and found.found[grid.inside].mean() > 0.97
    triangles = grid.triangles(found.found)
    assert len(triangles) and found.found[triangles].all()
    a, b, c = (grid.points[triangles[:, k]] for k in range(3))
    side, other = b - a, c - a
    assert (side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0] < 0).all()  # all the same way round
    for wrong in ({"mask": np.ones((3, 3))}, {"step": 0}, {"mask": np.zeros((180, 240))}):
        with pytest.raises(ObservationError):
            Grid.of((240, 180), **({"step": 5} | wrong))


def test_a_wrong_seed_grows_nothing(stretched):
    grid = Grid.of((240, 180), 8, margin=25)
    found = grow(*stretched, grid, Seeds.of([[120.0, 90.0]], [[60.0, 120.0]]))
    assert found.found.sum() == 0


def test_a_heap_gives_the_largest_first():
    rng = np.random.default_rng(0)
    keys, items, size = np.empty(200), np.empty(200, np.int64), 0
    values = rng.normal(size=150)
    for i, value in enumerate(values):
        size = push(keys, items, size, value, i)
    out = []
    while size:
        item, size = pop(keys, items, size)
        out.append(values[item])
    assert out == sorted(values, reverse=True)


def test_correlation_is_that_of_its_definition():
    first, second = scenes.pair(move=(5.0, -3.0), noise=1.0)
    found = search_box(first, second, [[80.0, 60.0]], reach=8)
    np.testing.assert_array_equal(found.uv, [[85.0, 57.0]])
    one, two = first.grey[54:67, 74:87].ravel(), second.grey[51:64, 79:92].ravel()
    assert found.best[0] == pytest.approx(np.corrcoef(one, two)[0, 1], abs=1e-5)
    assert found.runner_up[0] < 0.8 * found.best[0]
    assert np.isnan(search_box(first, second, [[2.0, 60.0]], reach=8).best[0])


def test_repeated_texture_shows_in_the_runner_up():
    y, x = np.mgrid[:120, :160]
    image = SplineImage.of(100 + 40 * np.sin(2 * np.pi * x / 16) * np.sin(2 * np.pi * y / 16))
    found = search_box(image, image, [[80.0, 60.0]], reach=20)
    assert found.runner_up[0] > 0.99
