"""A skin of another shape on a body's own bones."""

import numpy as np
import pytest
from tests.bodies.morphs.anny.test_anny import made_up

from kinefit.bodies.morphs.anny import AnnyModel
from kinefit.fitting.subject.surfaces import with_flesh


@pytest.fixture(scope="module")
def model():
    return AnnyModel(made_up())


def test_the_same_shape_on_other_bones_is_the_scaled_body(model):
    usual = model.body()
    scales = np.random.default_rng(0).uniform(0.9, 1.1, len(usual.scale_groups))
    body = usual.scaled(scales)
    same = with_flesh(body, usual, usual)
    np.testing.assert_allclose(same.skin.nodes, body.skin.nodes, atol=1e-12)
    np.testing.assert_array_equal(same.tree.offsets, body.tree.offsets)
    for a, b in zip(same.surfaces, body.surfaces, strict=True):
        np.testing.assert_allclose(a.radii, b.radii)


def test_another_shape_leaves_bones_and_points_and_moves_the_skin_with_its_joints(model):
    usual, other = model.body(), model.body(model.phenotype(weight=0.9, height=0.8))
    body = usual.scaled(np.full(len(usual.scale_groups), 1.05))
    body = body.with_keypoints("COCO_17", body.keypoints("COCO_17").points + 0.01)
    made = with_flesh(body, other, usual)
    np.testing.assert_array_equal(made.tree.offsets, body.tree.offsets)
    np.testing.assert_array_equal(made.keypoints("COCO_17").points, body.keypoints("COCO_17").points)
    assert np.abs(made.skin.nodes - body.skin.nodes).max() > 1e-3
    assert made.family.shape["weight"] == pytest.approx(0.9)
    back = with_flesh(made, usual, other)
    np.testing.assert_allclose(back.skin.nodes, body.skin.nodes, atol=1e-9)
    for a, b in zip(back.surfaces, body.surfaces, strict=True):
        np.testing.assert_allclose(a.radii, b.radii)
