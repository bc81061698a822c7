"""Metaballs: the field and its exact derivatives, nearest points, the closed mesh, files; what cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import central_differences, design

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.serial import save_body, saved_body
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.closest._kernels_metaballs import field
from kinefit.bodies.surfaces.metaballs import pack_balls
from kinefit.bodies.surfaces.places import SurfaceAnchors, nearest
from kinefit.errors import BodyError
from kinefit.geometry.se3 import exp_so3
from kinefit.solving.correspondences import surface_rows

CENTRES = [[0, -0.03, 0], [0.01, -0.14, 0], [0, -0.26, 0.005]]
RADII = [[0.075, 0.11, 0.075], [0.08, 0.12, 0.07], [0.06, 0.1, 0.055]]
LIMB = Metaballs.of(1, CENTRES, RADII, [1.0, 1.4, 0.9], exp_so3(np.array([[0, 0, 0], [0.1, 0.3, 0], [0, 0, 0.2]])))
X = np.random.default_rng(0).uniform([-0.1, -0.4, -0.1], [0.1, 0.1, 0.1], (60, 3))


def test_the_field_is_the_papers():
    out = np.zeros(len(X))
    for c, r, w, A in zip(LIMB.centres, LIMB.radii, LIMB.weights, LIMB.axes):
        for n, x in enumerate(X):
            d = sum((A[a] @ (x - c) / r[a]) ** 2 for a in range(3))  # eq. 7
            out[n] += w * np.exp(-2 * d)  # eq. 8
    assert LIMB.field(X) == pytest.approx(out) and LIMB.derivatives(X).value == pytest.approx(out)
    balls = pack_balls([LIMB], np.zeros((2, 3))).balls
    kernel = np.array([field(balls, 0, 3, *x) for x in X])
    assert kernel[:, 0] == pytest.approx(out) and kernel[:, 1:] == pytest.approx(LIMB.derivatives(X).by_point)
    one = Metaballs.of(0, [[0, 0, 0]], [[0.1, 0.2, 0.1]])
    assert np.ptp(one.vertices[:, 1]) / 2 == pytest.approx(0.2 * np.sqrt(np.log(2) / 2), rel=1e-6)


def test_derivatives_by_point_radii_weights_and_length():
    told, h = LIMB.derivatives(X), 1e-6

    def slope(change):
        return (change(h).field(X) - change(-h).field(X)) / (2 * h)

    for a in range(3):
        e = h * np.eye(3)[a]
        numeric = (LIMB.field(X + e) - LIMB.field(X - e)) / (2 * h)
        assert told.by_point[:, a] == pytest.approx(numeric, abs=1e-6)
        for k in range(3):
            def wider(s, k=k, a=a):
                radii = LIMB.radii.copy()
                radii[k, a] += s
                return replace(LIMB, radii=radii)
            assert told.by_radii[:, k, a] == pytest.approx(slope(wider), abs=1e-6)
    for k in range(3):
        heavier = slope(lambda s, k=k: replace(LIMB, weights=LIMB.weights + s * np.eye(3)[k]))
        assert told.by_weights[:, k] == pytest.approx(heavier, abs=1e-8)
    longer = slope(lambda s: replace(LIMB, centres=LIMB.centres * np.exp(s), radii=LIMB.radii * np.exp(s)))
    assert told.by_length == pytest.approx(longer, abs=1e-7)


def test_the_mesh_is_closed_and_on_the_surface():
    assert LIMB.open_edges == 0
    assert LIMB.field(LIMB.vertices) == pytest.approx(0.5, abs=1e-9)
    edges = np.sort(np.concatenate([LIMB.faces[:, [0, 1]], LIMB.faces[:, [1, 2]], LIMB.faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    a, b, c = (LIMB.vertices[LIMB.faces[:, k]] for k in range(3))
    normals, middles = np.cross(b - a, c - a), (a + b + c) / 3
    outward = -LIMB.derivatives(middles).by_point
    assert (np.einsum("ni,ni->n", normals, outward) > 0).all()
    assert np.abs((LIMB.field(middles) - 0.5) / np.linalg.norm(outward, axis=1)).max() < 2e-3  # chords


def test_longer_bones_and_the_other_side_take_balls_along():
    twice = LIMB.scaled(2.0)
    assert isinstance(twice, Metaballs) and twice.field(2 * X) == pytest.approx(LIMB.field(X))
    assert twice.field(twice.vertices) == pytest.approx(0.5, abs=1e-9)
    flip = np.array([1.0, 1.0, -1.0])
    assert LIMB.mirrored().field(X * flip) == pytest.approx(LIMB.field(X))
    assert LIMB.on(3).segment == 3 and LIMB.on(3).field(X) == pytest.approx(LIMB.field(X))
    body = load_body("arm_metaballs")
    longer = body.scaled(np.full(len(body.scale_groups), 1.1))
    assert [type(s) for s in longer.surfaces] == [Metaballs] * 3
    assert longer.surfaces[0].radii == pytest.approx(1.1 * body.surfaces[0].radii)


BODY = load_body("arm_metaballs")
STATE = BodyState(np.eye(4), np.radians([20, -10, 5, 60, 55, 5, 5]).astype(float))


def near(count=200, seed=0, spread=0.02):
    rng, out = np.random.default_rng(seed), []
    frames = BODY.tree.forward(STATE.T_world_root, STATE.angles)[0]
    for limb in BODY.surfaces:
        x = limb.vertices[rng.integers(0, len(limb.vertices), count)] + rng.normal(0, spread, (count, 3))
        f = frames[limb.segment]
        out.append((x + BODY.tree.rest[limb.segment]) @ f[:9].reshape(3, 3).T + f[9:])
    return np.concatenate(out)


def test_nearest_points_are_feet_of_perpendiculars():
    x = near()
    told = nearest(BODY, STATE, x, max_distance=0.1)
    good = (told.segment >= 0) & (told.distance > -0.01)
    assert good.mean() > 0.7
    frames = BODY.tree.forward(STATE.T_world_root, STATE.angles)[0]
    for limb in BODY.surfaces:
        own = good & (told.segment == limb.segment)
        f = frames[limb.segment]
        R = f[:9].reshape(3, 3)
        foot = (told.point[own] - f[9:]) @ R - BODY.tree.rest[limb.segment]
        d = limb.derivatives(foot)
        slope = np.linalg.norm(d.by_point, axis=1)
        assert np.abs((d.value - 0.5) / slope).max() < 2e-4
        straight = np.einsum("ni,ni->n", told.normal[own] @ R, -d.by_point / slope[:, None])
        assert np.quantile(straight, 0.02) > 1 - 1e-6 and straight.min() > 0.99  # from within, feet may be several
        local = (x[own] - f[9:]) @ R - BODY.tree.rest[limb.segment]
        brute = np.linalg.norm(limb.vertices[None] - local[:, None], axis=2)
        assert (np.abs(told.distance[own]) < brute.min(axis=1) + 1e-4).all()


def test_rows_have_the_derivative_of_their_residuals():
    x = near(30, spread=0.004)
    rows = surface_rows(BODY, STATE, x, max_distance=0.05)
    of = rows.segment.copy()

    def residual(state):
        return surface_rows(BODY, state, x[rows.group], max_distance=0.1, segment=of).residual

    slope = central_differences(residual, BODY, STATE, 1e-5)
    np.testing.assert_allclose(-design(rows, BODY, STATE), slope, atol=1e-3)


def test_a_surface_that_grows_moves_its_anchors_by_the_exact_speed():
    body, h = BODY, 1e-4
    x = near(40, seed=2, spread=1e-9)
    told = nearest(body, STATE, x, max_distance=0.02)
    frames = body.tree.forward(STATE.T_world_root, STATE.angles)[0]
    limb = body.surfaces[1]
    own = told.segment == limb.segment
    f = frames[limb.segment]
    R = f[:9].reshape(3, 3)
    rest, normal = (told.point[own] - f[9:]) @ R, told.normal[own] @ R
    anchors = SurfaceAnchors(body, told.segment[own], rest, normal)
    d = limb.derivatives(rest - body.tree.rest[limb.segment])
    for k, a in ((0, 0), (1, 2), (2, 1)):
        moved = []
        for sign in (h, -h):
            radii = limb.radii.copy()
            radii[k, a] += sign
            surfaces = tuple(limb.changed(radii) if s is limb else s for s in body.surfaces)
            moved.append(anchors.on(replace(body, surfaces=surfaces))[0])
        speed = np.einsum("ni,ni->n", (moved[0] - moved[1]) / (2 * h), normal)
        exact = d.by_radii[:, k, a] / np.linalg.norm(d.by_point, axis=1)
        assert speed == pytest.approx(exact, abs=0.02)  # corners move along their rays


def test_files_keep_balls(tmp_path):
    save_body(BODY, tmp_path / "arm.npz")
    again = saved_body(tmp_path / "arm.npz")
    for a, b in zip(again.surfaces, BODY.surfaces):
        assert isinstance(a, Metaballs) and np.array_equal(a.radii, b.radii) and np.array_equal(a.vertices, b.vertices)


@pytest.mark.parametrize(
    ("centres", "radii", "weights", "said"),
    [
        ([[0, 0, 0], [0, -1, 0]], [[0.1] * 3] * 2, None, "do not join"),
        ([[0, 0, 0]], [[0.1, -0.1, 0.1]], None, "ball 1 has radii"),
        ([[0, 0, 0]], [[0.1] * 3], [0.0], "weight 0"),
        ([[0, 0, 0]], [[0.1] * 3], [0.4], "do not join"),
        ([[0, 0, 0], [0, 0, 0]], [[0.1] * 3] * 2, None, "at the same position"),
        ([[0, 0, 0], [0, -0.2, 0], [0, -0.1, 0]], [[0.1] * 3] * 3, None, "order"),
        ([[0, 0, 0]], [[0.1] * 2], None, "centres"),
    ],
)
def test_balls_that_cannot_be(centres, radii, weights, said):
    with pytest.raises(BodyError, match=said):
        Metaballs.of(0, centres, radii, weights)


def test_body_files(tmp_path):
    text = '[body]\nname = "ball"\nstature = 1.0\n[[segment]]\nname = "a"\n'
    text += 'joint = { name = "root", type = "fixed" }\nscale = "a"\n'
    balls = "surface = { balls = [{ at = [0, 0, 0], radii = [0.1, 0.2, 0.1], weight = 1.2, turn = [0, 0, 90] }] }\n"
    path = tmp_path / "ball.toml"
    path.write_text(text + balls)
    limb = load_body(str(path)).surfaces[0]
    assert np.ptp(limb.vertices[:, 0]) > 1.9 * np.ptp(limb.vertices[:, 1])  # turned about z
    path.write_text(text + balls.replace("balls = [", 'mesh = "x.obj", balls = ['))
    with pytest.raises(BodyError, match="one shape"):
        load_body(str(path))
    path.write_text(text + balls.replace("1.2", "0.3"))
    with pytest.raises(BodyError, match="do not join"):
        load_body(str(path))


def test_the_exported_limbs_are_closed(tmp_path):
    from benchmarks.surface_body import moving_arm

    from kinefit.bodies.rendering.looks import body_mesh
    from kinefit.exporters import write_glb

    motion = replace(moving_arm(0, 3), body=BODY)
    write_glb(motion, tmp_path / "arm.glb")
    assert (tmp_path / "arm.glb").read_bytes()[:4] == b"glTF"
    mesh = body_mesh(BODY)
    edges = np.sort(np.concatenate([mesh.triangles[:, k] for k in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
