"""What stands still behind a body: learnt, followed, marked; and never the body itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinefit.geometry.camera import Camera
from kinefit.sensors.surfaces.depth_view import Background

WALL, BODY, SIGMA, WAIT = 4.0, 2.5, 0.01, 8
CAMERA = Camera("depth", (80, 60), np.array([[70.0, 0, 39.5], [0, 70.0, 29.5], [0, 0, 1]]))
WHERE = slice(15, 45), slice(30, 50)  # the body's pixels
WHOLE = (0, 0), (60, 80)


def box(margin=0.25, camera=CAMERA):
    """Box of the world that the body may be in: its pixels at its depth, and a margin."""
    (v, u), (f, cu, cv) = WHERE, (camera.matrix[0, 0], camera.matrix[0, 2], camera.matrix[1, 2])
    low = np.array([(u.start - cu) / f * BODY, (v.start - cv) / f * BODY, BODY]) - margin
    high = np.array([(u.stop - cu) / f * BODY, (v.stop - cv) / f * BODY, BODY]) + margin
    return low, high


def scene(body=True, seed=0, noise=SIGMA / 3, **things):
    """(H, W) [m] a wall, the body before it, and things: name=(rows, columns, depth)."""
    depth = np.full((60, 80), WALL)
    if body:
        depth[WHERE] = BODY
    for rows, columns, z in things.values():
        depth[rows, columns] = np.minimum(depth[rows, columns], z)
    return (depth + noise * np.random.default_rng(seed).normal(size=depth.shape)).astype(np.float32)


def shown(shift=0):
    """(h, w) [m] the body as it is drawn, in half of the size; put aside by some pixels."""
    out = np.full((30, 40), np.inf, np.float32)
    out[8:22, 15 + shift : 25 + shift] = BODY
    return out


def taught(images, sure=True, drawn=None, background=None):
    background = background or Background(CAMERA, SIGMA, WAIT)
    for image in images:
        background.learn(image, shown() if drawn is None else drawn, box(), sure)
    return background


def marks(background, image, first=WHOLE[0], last=WHOLE[1]):
    """(H, W) bool, what is marked; all else must be as it was."""
    out = background.marked(image, first, last)
    assert np.array_equal(np.abs(out), image)
    return out < 0


IS_BODY = np.zeros((60, 80), bool)
IS_BODY[WHERE] = True
FAR = np.ones((60, 80), bool)  # what is not about the body's outline
FAR[9:51, 24:56] = False


def test_nothing_is_marked_before_anything_is_learnt():
    background = Background(CAMERA, SIGMA, WAIT)
    assert not marks(background, scene()).any()
    taught([scene()], sure=False, background=background)
    assert not marks(background, scene()).any()


def test_one_image_tells_the_scene_and_leaves_the_body():
    background = taught([scene()])
    marked = marks(background, scene(seed=1))
    assert marked[FAR].mean() > 0.99 and not marked[IS_BODY].any()


def test_noise_is_learnt_with_time():
    loud = [scene(seed=s, noise=3 * SIGMA) for s in range(80)]
    early, late = (marks(taught(loud[:n]), scene(seed=99, noise=3 * SIGMA))[FAR].mean() for n in (1, 80))
    assert early < 0.96 < 0.97 < late


def test_a_body_that_walks_before_the_known_scene_stays_unmarked():
    background = taught([scene(seed=s) for s in range(4)])
    away = scene(body=False, walker=(slice(15, 45), slice(2, 20), BODY))
    marked = marks(background, away)
    assert not marked[15:45, 2:20].any() and marked[FAR & (away > 3)].mean() > 0.99


def test_what_the_body_uncovers_is_learnt():
    background = taught([scene()])
    clear = scene(body=False)
    aside = shown(shift=-12)
    assert not marks(background, clear)[20:40, 34:46].any()
    taught([scene(body=False, seed=s) for s in range(4)], drawn=aside, background=background)
    assert marks(background, clear)[20:40, 34:46].all()


def test_a_thing_in_the_room_that_is_taken_away_shows_the_wall():
    cupboard = {"cupboard": (slice(0, 60), slice(60, 75), 3.5)}
    background = taught([scene(**cupboard)])
    assert marks(background, scene(**cupboard))[:, 60:75].all()
    taught([scene(seed=s) for s in range(4)], background=background)
    assert marks(background, scene())[:, 60:75].all()
    assert not marks(background, scene(**cupboard))[:, 60:75].any()  # it would be something new


def test_what_comes_before_the_known_scene_is_not_learnt_however_long_it_stays():
    background = taught([scene()])
    visitor = {"visitor": (slice(10, 50), slice(62, 70), 3.0)}
    taught([scene(seed=s, **visitor) for s in range(30)], background=background)
    assert not marks(background, scene(**visitor))[10:50, 62:70].any()


def put_down(count, sure):
    """Marks on a thing beside the body, where nothing was measured before, after it was seen so many times."""
    rows, columns = slice(20, 40), slice(55, 57)
    unknown = scene()
    unknown[rows, columns] = 0.0
    thing = {"thing": (rows, columns, BODY)}
    background = taught([unknown])
    taught([scene(seed=s, **thing) for s in range(count)], sure, background=background)
    return marks(background, scene(seed=99, **thing))[rows, columns]


def test_a_thing_near_the_body_is_learnt_only_after_a_while():
    assert not put_down(WAIT // 2, sure=True).any() and put_down(2 * WAIT, sure=True).mean() > 0.95


@pytest.mark.parametrize("sure", [True, False])
def test_a_body_that_stands_still_is_not_learnt(sure):
    background = taught([scene()])
    taught([scene(seed=s) for s in range(60)], sure, background=background)
    assert not marks(background, scene())[IS_BODY].any()


def test_a_body_that_is_thought_elsewhere_is_not_learnt_unless_that_is_sure():
    still = [scene(seed=s) for s in range(60)]
    for sure in (False, True):
        background = taught(still, sure, shown(shift=10), taught([scene()]))
        assert marks(background, scene())[20:40, 32:40].any() == sure


def test_a_board_before_the_body_is_not_taken_for_what_stands_behind_it():
    """What was hidden for a while is the body's own again in the first image that shows it."""
    background = taught([scene(seed=s) for s in range(8)])
    board = {"board": (slice(0, 60), slice(20, 60), 1.0)}
    taught([scene(seed=s, **board) for s in range(40)], background=background)
    marked = marks(background, scene())
    assert not marked[IS_BODY].any() and marked[FAR].mean() > 0.99


def test_a_board_that_was_learnt_is_forgotten_once_the_body_is_seen_behind_it():
    board = {"board": (slice(0, 60), slice(20, 60), 1.0)}
    aside = shown(shift=-14)
    background = taught([scene(**board)], drawn=aside)
    assert marks(background, scene(**board))[IS_BODY].any()
    taught([scene(seed=s) for s in range(4)], background=background)
    assert not marks(background, scene())[IS_BODY].any()


def test_a_thing_beside_the_body_that_is_taken_away_is_forgotten_after_a_while():
    """In the box of the body, and before a part of it."""
    tray = {"tray": (slice(25, 30), slice(30, 50), BODY - 0.2)}
    background = taught([scene(**tray)], drawn=shown(shift=-14))
    taught([scene(seed=s, **tray) for s in range(3 * WAIT)], drawn=shown(shift=-14), background=background)
    assert marks(background, scene(**tray))[25:30, 32:48].all()
    taught([scene(seed=s) for s in range(2)], background=background)
    assert marks(background, scene())[25:30, 32:48].any()
    taught([scene(seed=s) for s in range(3 * WAIT)], background=background)
    assert not marks(background, scene())[25:30, 32:48].any()


def test_only_the_window_is_marked_and_the_image_is_left_alone():
    background, image = taught([scene()]), scene(seed=1)
    before = image.copy()
    inside = np.zeros((60, 80), bool)
    inside[10:20, 5:12] = True
    marked = marks(background, image, (10, 5), (20, 12))
    assert marked[inside].mean() > 0.95 and not marked[~inside].any()
    assert np.array_equal(image, before)


def test_an_empty_scene_that_is_told_is_known():
    background = Background(CAMERA, SIGMA, WAIT)
    empty = scene(body=False, noise=0.0)
    empty[:, :10] = 0.0
    background.know(empty)
    marked = marks(background, scene(seed=1))
    assert marked[:, 10:][~IS_BODY[:, 10:]].mean() > 0.99 and not marked[IS_BODY].any() and not marked[:, :10].any()
    taught([scene(seed=s) for s in range(4)], background=background)
    assert marks(background, scene(seed=9))[FAR].mean() > 0.98


@pytest.mark.parametrize("size", [(640, 480), (641, 479), (7, 5)])
def test_images_of_any_size(size):
    width, height = size
    K = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    background = Background(Camera("depth", size, K), SIGMA, WAIT)
    wall = np.full((height, width), WALL, np.float32)
    low, high = np.array([-0.1, -0.1, 2.0]), np.array([0.1, 0.1, 2.5])
    for sure in (True, True, False):
        background.learn(wall, np.full((6, 8), np.inf, np.float32), (low, high), sure)
    assert (background.marked(wall, (0, 0), (height, width)) < 0).all()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_whatever_comes_only_signs_change(seed, count):
    rng = np.random.default_rng(seed)
    background = Background(CAMERA, SIGMA, WAIT)
    for _ in range(count):
        image = rng.choice(np.array([0.0, 0.3, 1.0, BODY, WALL, 50.0], np.float32), (60, 80))
        background.learn(image, shown(int(rng.integers(-10, 10))), box(), bool(rng.integers(2)))
        out = background.marked(image, *WHOLE)
        assert np.array_equal(np.abs(out), image)
