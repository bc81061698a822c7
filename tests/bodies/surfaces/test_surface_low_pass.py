"""Low frequencies of a mesh: what stays, and what goes."""

from dataclasses import replace

import numpy as np

from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing, low_pass
from kinefit.bodies.surfaces.fourier import FourierSurface, levels


def bumpy(height):
    """A torus with bumps of high frequency, its triangles, and the torus without them."""
    u, v = np.meshgrid(np.arange(48) / 48, np.arange(32) / 32, indexing="ij")
    a, b = 2 * np.pi * u, 2 * np.pi * v
    r = 0.1 + height * np.cos(12 * a) * np.cos(10 * b)
    grid = np.stack([(0.3 + r * np.cos(b)) * np.cos(a), r * np.sin(b), (0.3 + r * np.cos(b)) * np.sin(a)], axis=-1)
    return FourierSurface.of(grid).triangles((48, 32))


def test_bumps_go_and_the_shape_stays():
    (rough, faces), (smooth, _) = bumpy(0.008), bumpy(0.0)
    before, after = (np.linalg.norm(x - smooth, axis=1).mean() for x in (rough, low_pass(rough, faces, 20)))
    assert after < 0.5 * before
    size = [np.ptp(x, axis=0) for x in (smooth, low_pass(smooth, faces, 20))]
    np.testing.assert_allclose(size[1], size[0], rtol=0.03)  # nothing shrinks
    np.testing.assert_array_equal(low_pass(rough, faces, 0), rough)


def test_a_body_that_morphs_still_does():
    model = Morphing(load_body("humanoid_morphing"))
    (smooth, whole), state = model.levels(2), model.body.default_state()
    angles = np.array(state.angles)
    angles[model.body.tree.coordinate("arm_add_r")] = np.radians(-110.0)
    raised = type(state)(state.T_world_root, angles)
    for other in (state, raised):
        gap = np.linalg.norm(smooth.pose(other).vertices - model.pose(other).vertices, axis=1)
        assert 1e-4 < gap.mean() < 0.05
    assert whole is model
    stiff = Morphing(model.body, operators=()).levels(2)[0]
    assert np.abs(stiff.pose(raised).vertices - smooth.pose(raised).vertices).max() > 0.03


def test_a_body_of_series_goes_through_their_orders(tmp_path):
    """P1 2.4: nodes of a body file's series, stretched and in another unit, come from its low-pass approximations."""
    turn, height = 2 * np.pi * np.arange(24)[:, None] / 24, np.linspace(0, 0.3, 17)[None]
    r = 0.05 + 0.02 * np.sin(40 * height) + 0.006 * np.cos(5 * turn)
    grid = np.stack(np.broadcast_arrays(r * np.cos(turn), height, -r * np.sin(turn)), axis=-1)
    np.savetxt(tmp_path / "vase.csv", 1e3 * grid.reshape(-1, 3), delimiter=",")
    text = '[body]\nname = "vase"\n[[segment]]\nname = "vase"\njoint = { name = "free", type = "free" }\n'
    text += 'surface = { fourier = "vase.csv", unit = "mm", grid = [24, 17], closed = [true, false], '
    text += "nodes = [32, 20] }\n"
    (tmp_path / "vase.toml").write_text(text)
    body, series = load_body(tmp_path / "vase.toml"), FourierSurface.of(grid, closed=(True, False))
    body = replace(body, surfaces=(body.surfaces[0].scaled(2.0).mirrored(),))
    for found, expected in zip(Morphing(body).levels(3), levels(series, 3), strict=True):
        nodes = expected.triangles((32, 20))[0] * (2.0, 2.0, -2.0)
        np.testing.assert_allclose(found.pose(body.default_state()).vertices, nodes, atol=1e-9)
