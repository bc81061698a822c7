"""Morphs: the paper's forms and the fast ones agree, derivatives, and a fit that sees the morphed body."""

import numpy as np
import pytest
from tests.oracle import random_body

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import (
    WEIGHTS,
    GlobalMorph,
    JointMotion,
    LocalMorph,
    Steering,
    radial_basis,
    weight_function,
)
from kinefit.bodies.surfaces import BodyMesh, SkinnedMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry import cga, lines, se3
from kinefit.solving.correspondences.contours.outlines import morphed_rows
from kinefit.solving.least_squares import gauss_newton

random = np.random.default_rng(0)


def random_mesh(body, count=60):
    """Nodes without meaning, some on every segment."""
    segment = np.sort(random.integers(0, len(body.tree.segments), count)).astype(np.int32)
    nodes = random.normal(scale=0.3, size=(count, 3)) + body.tree.rest[segment]
    return BodyMesh(nodes, np.zeros((0, 3), np.int32), segment, np.zeros(0, np.int32))


def random_skin(body, count=60):
    """Nodes without meaning, each blended between three segments that carry it at places of their own."""
    owners = random.integers(0, len(body.tree.segments), (count, 3))
    nodes = random.normal(scale=0.3, size=(count, 3, 3)) + body.tree.rest[owners]
    return SkinnedMesh(nodes, np.zeros((0, 3), int), owners, random.dirichlet(np.ones(3), count))


def everything(body, mesh):
    """Operators of every kind, several on one joint, patch and angle."""
    q = body.tree.coordinates
    steer = lambda k, weight="linear", beyond=False: Steering(q[k], -2.0, 2.0, weight, beyond)
    last, middle = body.tree.segments[-1], body.tree.segments[3]
    return [
        JointMotion(middle, 0.3 * random.normal(size=6), steer(0, "square")),
        JointMotion(last, 0.3 * random.normal(size=6), steer(1)),
        JointMotion.shift(last, [0.02, -0.05, 0.03], steer(2, "smoothstep")),
        GlobalMorph(mesh.vertices + 0.1 * random.normal(size=mesh.vertices.shape), steer(3, "sqrt")),
        LocalMorph(mesh.vertices[5], [0.2, 0.3, np.inf], [0.0, 0.0, 0.05], steer(0, beyond=True)),
        LocalMorph(mesh.vertices[7], [0.3, 0.3, 0.3], [0.03, 0.04, 0.0], steer(1, lambda t: np.cos(np.pi * t / 2))),
    ]


@pytest.fixture(scope="module")
def scene():
    body = random_body(2, segments=7)
    mesh = random_mesh(body)
    state = BodyState(se3.exp(random.normal(size=6)), random.uniform(-1.5, 1.5, len(body.tree.coordinates)))
    return body, mesh, state, everything(body, mesh)


@pytest.mark.parametrize("name", WEIGHTS)
def test_weights_go_from_one_to_zero_with_their_slopes(name):
    weight = weight_function(name)
    assert weight(0.0)[0] == 1.0
    assert abs(weight(1.0)[0]) < 1e-15
    t = np.linspace(0.01, 0.99, 50)
    values = np.array([weight(x)[0] for x in t])
    assert np.all(np.diff(values) < 0)
    slopes = [(weight(x + 1e-7)[0] - weight(x - 1e-7)[0]) / 2e-7 for x in t]
    np.testing.assert_allclose([weight(x)[1] for x in t], slopes, atol=1e-6)


def test_root_starts_fast_and_square_slowly():
    """P1 3.2: the square root morphs faster at the beginning, the square at the end."""
    at = {name: weight_function(name)(0.25)[0] for name in WEIGHTS}
    assert at["sqrt"] < at["linear"] < at["smoothstep"] < at["square"]
    assert at["sqrt"] == 0.5
    for t in (0.0, 0.0005, 0.001):
        low, high = weight_function("sqrt")(t), weight_function("sqrt")(t + 1e-9)
        assert abs(high[0] - low[0]) < 1e-7


def test_tables_and_functions_are_weights():
    table = weight_function([[0.0, 1.0], [0.5, 0.2], [1.0, 0.0]])
    assert table(0.25)[0] == pytest.approx(0.6)
    assert table(0.25)[1] == pytest.approx(-1.6)
    cosine = weight_function(lambda t: np.cos(np.pi * t / 2))
    assert cosine(0.5)[1] == pytest.approx(-np.pi / 2 * np.sin(np.pi / 4), abs=1e-8)


def test_steering_stands_still_beyond_its_ends():
    steering = Steering("q", 0.5, -1.5)
    assert steering.at(0.5) == (0.0, -0.5)
    assert steering.at(-0.5) == (0.5, -0.5)
    assert steering.at(1.0) == (0.0, 0.0)
    assert steering.at(-2.0) == (1.0, 0.0)
    assert Steering("q", 0.0, 2.0, beyond=True).at(-1.0) == (-0.5, 0.5)


def test_radial_basis_is_that_of_the_paper():
    x, y = random.normal(size=(2, 30))
    r_x, r_y, c_x, c_y = 0.5, 1.7, 0.2, -0.3
    expected = np.exp(-((x - c_x) ** 2) / r_x) * np.exp(-((y - c_y) ** 2) / r_y)
    np.testing.assert_allclose(radial_basis(np.c_[x, y], [c_x, c_y], np.sqrt([r_x, r_y])), expected, rtol=1e-12)
    np.testing.assert_allclose(radial_basis(np.c_[x, y], [c_x, 0], [1, np.inf]), np.exp(-((x - c_x) ** 2)), rtol=1e-12)


def printed_joint_motion(psi, other, t):
    """Mₜ Ψ M̃ₜ with Mₜ = exp(−½ t 2π Ξ) (P1 3.1)."""
    M_t = cga.interpolate(cga.between(psi, other), t)
    return (M_t * psi * ~M_t).grade(2)


def printed_global_morph(F_1, F_2, t, omega):
    """F_t = F_1 ω(t) + F_2 (1 − ω(t)) (P1 3.2), of Euclidean vectors."""
    return F_1 * omega(t) + F_2 * (1.0 - omega(t))


def printed_local_morph(F, r, scale, theta, direction):
    """T_r F T̃_r with T_r = 1 + ½ e t r and t = λ θ d (P1 3.3)."""
    translator = cga.translator(cga.vector(r[..., None] * (scale * theta * direction)))
    return cga.versor(translator, F)


def test_the_printed_forms_are_the_fast_ones():
    x = random.normal(size=(40, 3))
    d, r = np.array([0.0, 0.0, 1.0]), radial_basis(x, x[3], [0.5, 0.5, 0.5])
    bulge = LocalMorph(x[3], [0.5] * 3, 0.1 * d, Steering("q", 0.0, 1.0, beyond=True))
    found = cga.coordinates(printed_local_morph(cga.point(x), r, 0.1, 0.7, d))
    np.testing.assert_allclose(found, x + bulge.steering.at(0.7)[0] * bulge.field(x, None), atol=1e-12)
    y = x + random.normal(size=x.shape)
    blend = GlobalMorph(y, Steering("q", 0.0, 2.0, "square"))
    printed_form = printed_global_morph(cga.vector(x), cga.vector(y), 0.35, lambda t: 1 - t * t)
    fast = x + blend.steering.at(0.7)[0] * blend.field(x, None)
    np.testing.assert_allclose(np.moveaxis(printed_form.values, 0, -1), fast, atol=1e-12)
    line, other = lines.line_through(*random.normal(size=(2, 3))), lines.line_through(*random.normal(size=(2, 3)))
    hinge = JointMotion.between("s", line, other, Steering("q"))
    for t in (0.0, 0.3, 1.0):
        psi = printed_joint_motion(cga.screw(cga.line_of(line), 0.4), cga.screw(cga.line_of(other), 0.4), t)
        moved = lines.move_line(se3.exp(t * hinge.twist), line)
        np.testing.assert_allclose(cga.twist_coordinates(psi), 0.4 * np.roll(moved, 3), atol=1e-12)
    np.testing.assert_allclose(lines.move_line(se3.exp(hinge.twist), line), other, atol=1e-12)


def test_the_blend_begins_and_ends_at_the_two_surfaces(scene):
    body, mesh, state, _ = scene
    target = mesh.vertices + random.normal(size=mesh.vertices.shape)
    morphing = Morphing(body, mesh, [GlobalMorph(target, Steering(body.tree.coordinates[0], 0.0, 1.0))])
    for angle, expected in ((0.0, mesh.vertices), (1.0, target), (9.0, target), (0.5, (mesh.vertices + target) / 2)):
        angles = state.angles.copy()
        angles[0] = angle
        np.testing.assert_allclose(morphing.pose(BodyState(np.eye(4), angles)).nodes, expected, atol=1e-14)


def test_without_operators_it_is_the_body(scene):
    body, mesh, state, _ = scene
    pose = Morphing(body, mesh, []).pose(state)
    frames, screws = body.tree.forward(state.T_world_root, state.angles)
    np.testing.assert_allclose(pose.frames, frames, atol=1e-13)
    np.testing.assert_allclose(pose.screws, screws, atol=1e-13)
    np.testing.assert_allclose(pose.vertices, mesh.posed(frames), atol=1e-13)


def test_the_chain_is_the_product_of_the_papers_motors(scene):
    """Frames of a body with moving joints, by the motors of P1: M_j moves joint and limb before the joint turns it."""
    body, mesh, state, operators = scene
    pose, tree = Morphing(body, mesh, operators).pose(state), body.tree
    for s in range(len(tree.segments)):
        path, motor = [], cga.motor_of(state.T_world_root)
        while s >= 0:
            path, s = [s, *path], tree.parents[s]
        for k in path:
            for o in operators:
                if isinstance(o, JointMotion) and o.segment == tree.segments[k]:
                    weight = o.steering.at(state.angles[tree.coordinate(o.steering.coordinate)])[0]
                    motor = motor * cga.interpolate(cga.exp(cga.twist(o.twist)), weight)
            for d in range(tree.dof_start[k], tree.dof_start[k + 1]):
                axis, centre = tree.axes[d], tree.rest[k]
                xi = np.r_[axis, 0, 0, 0] if tree.prismatic[d] else np.r_[np.cross(centre, axis), axis]
                motor = motor * cga.exp(cga.twist(xi * state.angles[d]))
        frame = se3.transform(pose.frames[path[-1], :9].reshape(3, 3), pose.frames[path[-1], 9:])
        np.testing.assert_allclose(cga.matrix(motor), frame, atol=1e-12)


@pytest.mark.parametrize("blended", [False, True])
def test_derivatives_by_differences(scene, blended):
    body, mesh, state, operators = scene
    if blended:
        mesh = random_skin(body)
        operators = everything(body, mesh)
    morphing = Morphing(body, mesh, operators)
    J, h = morphing.pose(state).jacobian(np.arange(len(mesh.vertices))), 1e-6
    assert np.any(np.abs(J[:, :, 6:] - Morphing(body, mesh, []).pose(state).jacobian(range(60))[:, :, 6:]) > 1e-2)
    for k, d in enumerate(h * np.eye(body.tree.n_dofs)):
        difference = morphing.pose(state.retract(d)).vertices - morphing.pose(state.retract(-d)).vertices
        np.testing.assert_allclose(J[:, :, k], difference / (2 * h), atol=2e-8)


@pytest.mark.parametrize("blended", [False, True])
def test_a_bulge_that_moves_with_a_bone(scene, blended):
    """P1 3.3: the nodes about the bone's place in this pose bulge, along its direction; derivatives by differences."""
    body, mesh, state, operators = scene
    tree, bone = body.tree, body.tree.segments[4]
    mesh = random_skin(body) if blended else mesh
    centre, radii, shift = np.array([0.05, 0.1, 0.0]), np.array([0.5, 0.6, np.inf]), np.array([0.03, 0.0, 0.05])
    bulge = LocalMorph(centre, radii, shift, Steering(tree.coordinates[1], -2.0, 2.0), bone, moves=True)
    alone = Morphing(body, mesh, [bulge])
    pose, plain = alone.pose(state), Morphing(body, mesh, []).pose(state)
    weight = bulge.steering.at(state.angles[1])[0]
    R, t = plain.frames[4, :9].reshape(3, 3), plain.frames[4, 9:]
    if not blended:
        r = radial_basis((plain.vertices - t) @ R, tree.rest[4] + centre, radii)
        np.testing.assert_allclose(pose.vertices, plain.vertices + weight * r[:, None] * (R @ shift), atol=1e-12)
        still = Morphing(body, mesh, [LocalMorph(centre, radii, shift, bulge.steering, bone)]).pose(state)
        assert np.abs(still.vertices - pose.vertices).max() > 0.005
    model, index, h = Morphing(body, mesh, [*operators[:3], bulge]), np.arange(60), 1e-6
    found, expected = model.pose(state).jacobian(index), []
    for step in h * np.eye(tree.n_dofs):
        ahead, back = (model.pose(state.retract(sign * step)).vertices for sign in (1.0, -1.0))
        expected.append((ahead - back) / (2 * h))
    np.testing.assert_allclose(found, np.moveaxis(expected, 0, -1), atol=1e-7)
    with pytest.raises(BodyError, match="moves needs a segment"):
        LocalMorph(centre, radii, shift, bulge.steering, moves=True)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("blended", [False, True])
def test_a_bulge_whose_radii_turn_and_stretch_with_a_joint(scene, blended, moves):
    """P1 3.3: radii along axes of their own, deformed by the joint's angle; derivatives by differences."""
    body, mesh, state, operators = scene
    tree, bone = body.tree, body.tree.segments[4]
    mesh = random_skin(body) if blended else mesh
    centre, radii, shift = np.array([0.05, 0.1, 0.0]), np.array([0.3, 0.6, 0.9]), np.array([0.03, 0.0, 0.05])
    steer = Steering(tree.coordinates[1], -2.0, 2.0)
    shape = {"tilt": [0.0, 0.4, 0.2], "turn": [0.9, -0.3, 0.5], "stretch": [2.0, 0.7, 1.3]}
    bulge = LocalMorph(centre, radii, shift, steer, bone, moves=moves, **shape)
    pose, plain = Morphing(body, mesh, [bulge]).pose(state), Morphing(body, mesh, []).pose(state)
    weight = steer.at(state.angles[1])[0]
    R, t = (plain.frames[4, :9].reshape(3, 3), plain.frames[4, 9:]) if moves else (np.eye(3), np.zeros(3))
    away = ((plain.vertices if moves else plain.nodes) - t) @ R - tree.rest[4] - centre
    axes = se3.exp_so3(weight * np.array(shape["turn"])) @ se3.exp_so3(np.array(shape["tilt"]))
    r = np.exp(-np.sum((away @ axes / (radii * np.array(shape["stretch"]) ** weight)) ** 2, axis=1))
    if not (blended and moves):
        apart = np.linalg.norm(pose.nodes - plain.nodes, axis=1)
        np.testing.assert_allclose(apart, abs(weight) * r * np.linalg.norm(shift), atol=1e-12)
    for plainer in ({}, {"tilt": shape["tilt"]}):
        other = Morphing(body, mesh, [LocalMorph(centre, radii, shift, steer, bone, moves=moves, **plainer)])
        assert np.abs(other.pose(state).vertices - pose.vertices).max() > 1e-3
    model, h = Morphing(body, mesh, [*operators[:3], bulge]), 1e-6
    expected = [
        (model.pose(state.retract(step)).vertices - model.pose(state.retract(-step)).vertices) / (2 * h)
        for step in h * np.eye(tree.n_dofs)
    ]
    np.testing.assert_allclose(model.pose(state).jacobian(np.arange(60)), np.moveaxis(expected, 0, -1), atol=1e-7)


def shoulder():
    """The humanoid whose right shoulder sinks and comes forward as the arm does, twice morphed (P1, figure 9)."""
    body = load_body("humanoid")
    mesh = body_mesh(body)
    centre = body.tree.rest[body.tree.segment("upperarm_r")]
    down = Steering("arm_add_r", -np.pi / 2, 0.0, "smoothstep")
    forward = Steering("arm_flex_r", 0.0, np.pi / 2)
    return Morphing(
        body,
        mesh,
        [
            JointMotion.shift("upperarm_r", [0.0, -0.04, 0.0], down),
            JointMotion.shift("upperarm_r", [0.03, 0.0, 0.0], forward),
            LocalMorph(centre, [0.12] * 3, [0.0, -0.04, 0.0], down),
            LocalMorph(centre, [0.12] * 3, [0.03, 0.0, 0.0], forward),
        ],
    )


def test_a_fit_sees_the_morphed_body():
    """Gauss-Newton with the morph's derivative reaches the truth; the rigid body and a held morph fall behind."""
    morphing = shoulder()
    body, seen = morphing.body, np.arange(0, len(morphing.mesh.vertices), 7)
    truth = body.default_state().angles.copy()
    truth[[body.tree.coordinate(n) for n in ("arm_add_r", "arm_flex_r", "elbow_flex_r")]] = -0.8, 0.7, 0.6
    truth = BodyState(se3.exp([0.1, 0.2, 2.0, 0.1, -0.2, 0.1]), truth)
    target = morphing.pose(truth).vertices[seen]
    start = truth.retract(np.random.default_rng(1).normal(scale=0.1, size=body.tree.n_dofs))

    def fit(model, steps):
        state = start
        for _ in range(steps):
            pose = model.pose(state)
            away = target - pose.vertices[seen]
            rows = [morphed_rows(pose, seen, np.tile(n, (len(seen), 1)), away @ n) for n in np.eye(3)]
            state = gauss_newton(body, state, rows, limits=False).state
        return np.abs(state.angles - truth.angles).max()

    assert fit(morphing, 8) < 1e-9
    assert fit(Morphing(body, morphing.mesh, []), 8) > np.deg2rad(1)


def test_rows_leave_out_what_was_not_seen_and_refuse_nonsense():
    morphing = shoulder()
    pose = morphing.pose(morphing.body.default_state())
    n, r = np.tile([1.0, 0, 0], (4, 1)), np.array([0.01, np.nan, 0.02, 0.03])
    rows = morphed_rows(pose, [1, 2, 3, 4], n, r)
    fewer = morphed_rows(pose, [1, 3, 4], n[:3], r[[0, 2, 3]])
    np.testing.assert_allclose(rows.weight, fewer.weight)
    np.testing.assert_allclose(rows.weight @ rows.residual, fewer.weight @ fewer.residual)
    with pytest.raises(ObservationError, match="directions of shape .3, 3.. Give .4, 3."):
        morphed_rows(pose, [1, 2, 3, 4], n[:3], r)
    with pytest.raises(ObservationError, match="standard deviation"):
        morphed_rows(pose, [1, 2, 3, 4], n, r, sigma=0.0)


def steered(**changes):
    return Steering(**{"coordinate": "arm_add_r", **changes})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda b, m: [LocalMorph([0] * 3, [1] * 3, [0] * 3, steered(coordinate="arm"))], "no angle of body"),
        (lambda b, m: [JointMotion.shift("arm", [0] * 3, steered())], "no segment 'arm'"),
        (lambda b, m: [JointMotion.shift("pelvis", [0] * 3, steered())], "the root has no joint"),
        (lambda b, m: [GlobalMorph(m.vertices[:-1], steered())], "a morph to"),
        (lambda b, m: [GlobalMorph(m.vertices * np.nan, steered())], "not finite"),
        (lambda b, m: [LocalMorph([0] * 2, [1] * 2, [0] * 3, steered())], "a bulge with centre"),
        (lambda b, m: [LocalMorph([0] * 3, [1, 0, 1], [0] * 3, steered())], "radii .* of a bulge"),
        (lambda b, m: steered(start=1.0, end=1.0), "steered by arm_add_r from 1.0 to 1.0"),
        (lambda b, m: steered(weight="cubic"), "no weighting 'cubic'"),
        (lambda b, m: steered(weight=lambda t: t), r"ω\(0\) = 0.0"),
        (lambda b, m: steered(weight=[[0.0, 1.0]]), "table of weights"),
        (lambda b, m: steered(weight="square", beyond=True), "must be linear"),
    ],
)
def test_bad_input_says_what_is_wrong(make, message):
    body = load_body("humanoid")
    mesh = body_mesh(body)
    with pytest.raises(BodyError, match=message):
        Morphing(body, mesh, make(body, mesh))
