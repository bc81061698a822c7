"""Seeds that are found along lines of sight, and grids that are matched without any."""

import numpy as np
import pytest
from tests.images.photogrammetry import scenes

from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.least_squares_matching import Grid
from kinefit.images.photogrammetry.seeding.unaided import grow_between, grow_over_time, ray_seeds
from kinefit.images.photogrammetry.spline_image import SplineImage

TEXTURE = scenes.Texture(0.005, 3)
RIG = Rig(scenes.three().cameras[:2])
GRID = Grid.of((200, 150), 12, margin=12)


def where(place, pose, to, at):
    """Places (N, 2) of one camera's image on the plane, in another's, and whether they are inside it."""
    back, ray = se3.inverse(pose), place.ray(at)
    origin, d = se3.apply(back, place.centre_world), ray @ back[:3, :3].T
    uv = to.project(place.centre_world + ray * (-origin[2] / d[:, 2])[:, None])
    return uv, ((uv > 12) & (uv < np.array(to.size) - 12)).all(axis=1)


@pytest.mark.parametrize("turn", [0.0, 0.5, -0.8])
def test_windows_are_found_on_their_lines_though_a_camera_is_turned(turn):
    rng, one = np.random.default_rng(0), RIG.cameras[0]
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3(np.array([0.0, 0.0, turn]))  # about its own axis
    two = RIG.cameras[1].with_pose(T @ RIG.cameras[1].T_camera_world)
    pose = se3.transform(se3.exp_so3(np.array([0.1, 0.1, 0.0])), np.zeros(3))
    images = [scenes.plane_image(c, TEXTURE, pose, 2.0, rng) for c in (one, two)]
    seeds, index = ray_seeds(*images, (one, two), GRID.points)
    goal, inside = where(one, pose, two, GRID.points)
    assert len(index) > 0.6 * inside.sum()
    off = np.linalg.norm(seeds.second - goal[index], axis=1)[inside[index]]
    assert np.median(off) < 1.0 and np.mean(off < 3.0) > 0.97
    shift = where(one, pose, two, GRID.points + (4.0, 0.0))[0] - goal
    told = seeds.deformation @ np.array([4.0, 0.0])
    assert np.median(np.linalg.norm(told - shift[index], axis=1)) < 0.8  # the plane is inclined a little


def two_plates():
    """Two patches of texture at other distances, on a ground without any: nothing grows from one to the other."""
    rng, out = np.random.default_rng(1), []
    for camera in RIG:
        near, far = (
            scenes.plane_image(camera, TEXTURE, se3.transform(np.eye(3), np.array([0.0, 0.0, z]))).grey
            for z in (-0.1, 0.1)
        )
        image = np.full_like(near, 100.0)
        image[30:70] = near[30:70]
        image[85:125] = far[85:125]
        out.append(SplineImage.of(image + 2.0 * rng.normal(size=image.shape)))
    return out


def test_each_part_of_a_scene_gets_seeds_of_its_own():
    images = two_plates()
    grid = Grid.of((200, 150), 6, margin=12)
    found = grow_between(*images, (RIG.cameras[0], RIG.cameras[1]), grid, window=13, least=0.8)
    for z, low, high in ((-0.1, 38, 62), (0.1, 93, 117)):
        goal, inside = where(RIG.cameras[0], se3.transform(np.eye(3), np.array([0, 0, z])), RIG.cameras[1], grid.points)
        mine = inside & (grid.points[:, 1] > low) & (grid.points[:, 1] < high)
        assert found.found[mine].mean() > 0.9
        good = mine & found.found
        np.testing.assert_allclose(found.uv[good], goal[good], atol=0.5)


@pytest.mark.parametrize("move", [(9.0, -6.0), (45.0, 0.0)])
def test_a_later_image_is_matched_from_near_and_from_far(move):
    first, second = scenes.pair(size=(300, 240), move=move, noise=2.0, grain=2.0)
    grid = Grid.of((300, 240), 12, margin=60)
    found = grow_over_time(first, second, grid, window=13, least=0.8)
    assert found.found.mean() > 0.95
    np.testing.assert_allclose(found.uv[found.found], grid.points[found.found] + move, atol=0.3)
