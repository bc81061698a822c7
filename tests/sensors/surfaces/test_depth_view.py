"""Views of one person: what was seen, what is empty, the ends of limbs; scores of poses in them."""

from dataclasses import replace

import numpy as np
from tests.fitting.tracking.depth_oracle import ARMS, BODY, camera, depth_of, facing

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.limbs import limbs, of_fingers
from kinefit.bodies.rendering import Canvas, rasterise
from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.surfaces.mesh import triangles
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.fitting.initialization.depth_score import MAX_DEPTH_ERROR, OVERLAP_COST, POSTURE_COST, Score, prior_sigmas
from kinefit.sensors.surfaces.depth_view import UNMEASURED_TRUST, geodesic_ends, outside, splat, view_of

CAMERA = camera()


def flat(mask, z=2.0):
    return np.where(mask, z, 0.0)


def test_a_view_holds_what_the_image_holds():
    state = facing(**ARMS)
    depth = depth_of(BODY, state, CAMERA, noise=0.0)
    view = view_of(depth, depth > 0, CAMERA)
    uv = np.rint(CAMERA.project(view.cloud)).astype(int)
    z = view.cloud @ CAMERA.T_camera_world[2, :3] + CAMERA.T_camera_world[2, 3]
    # a pixel of the view takes its depth from the nearest pixel of the image and keeps its own ray
    assert np.median(np.abs(depth[uv[:, 1], uv[:, 0]] - z)) < 1e-6
    assert max(view.observed.shape) < 140
    assert np.allclose(view.viewpoint, CAMERA.centre_world)


def test_what_is_empty_what_is_behind_and_what_lies_beside_the_image():
    person = np.zeros((240, 320), bool)
    person[100:240, 0:60] = True
    depth = np.where(person, 2.0, 0.0)
    depth[:100] = 3.0
    view = view_of(depth, person, CAMERA)
    assert view.trust[:, 0].max() == 0.0 and view.trust[-1].max() == 0.0  # the image ends left and below
    assert set(np.unique(view.trust)) == {0.0, UNMEASURED_TRUST, 1.0}
    wall = np.isfinite(view.behind)
    assert wall.any() and np.all(view.behind[wall] == 3.0) and np.all(view.trust[wall] == 1.0)
    assert not np.isfinite(view.behind[view.seen]).any()


def test_distance_outside_the_outline():
    person = np.zeros((240, 320), bool)
    person[60:180, 100:200] = True
    depth = flat(person)
    view = view_of(depth, person, CAMERA)
    right = (199 - CAMERA.matrix[0, 2]) / 288.0 * 2.0  # [m] of the last column, in the camera
    for beyond in (0.05, 0.10):
        x_camera = np.array([[right + beyond, 0.0, 2.0], [0.0, 0.0, 2.0]])
        x = x_camera @ CAMERA.T_world_camera[:3, :3].T + CAMERA.centre_world
        gap, trust = outside(view, x)
        assert abs(gap[0] - beyond) < 0.025 and abs(gap[1] + right) < 0.025  # a pixel of the view
        assert trust[0] == UNMEASURED_TRUST and trust[1] == 1.0
    x_camera = np.array([[right - 0.05, 0.0, 2.0], [right - 0.05, 0.0, 2.3]])
    gap, trust = outside(view, x_camera @ CAMERA.T_world_camera[:3, :3].T + CAMERA.centre_world)
    assert abs(gap[0] + 0.05) < 0.025 and trust.tolist() == [1.0, 0.0]  # the second is measured nearer


def test_an_object_in_front_of_a_person_is_no_contour():
    person, covered = np.zeros((2, 240, 320), bool)
    person[60:180, 100:200], covered[60:180, 200:230] = True, True
    right = (199 - CAMERA.matrix[0, 2]) / 288.0 * 2.0
    x = np.array([[right - 0.05, 0.0, 2.0]]) @ CAMERA.T_world_camera[:3, :3].T + CAMERA.centre_world
    gaps = []
    for z in (1.0, 3.0):
        depth = np.where(covered, z, flat(person))
        gaps.append(outside(view_of(depth, person, CAMERA), x)[0][0])
    assert gaps[0] < -0.15 and abs(gaps[1] + 0.05) < 0.025


def test_ends_of_a_cross_and_of_a_part_that_is_torn_off():
    cross = np.zeros((240, 320), bool)
    cross[110:130, 60:260] = True
    cross[30:210, 150:170] = True
    for torn in (False, True):
        mask = cross.copy()
        if torn:
            mask[:, 90:95] = False
        depth = flat(mask)
        view = view_of(depth, mask, CAMERA)
        centre = view.cloud[np.argmin(np.linalg.norm(view.cloud - view.cloud.mean(axis=0), axis=1))]
        ends = geodesic_ends(view, centre, count=4)
        uv = CAMERA.project(ends)
        for tip in ((60, 120), (259, 120), (160, 30), (160, 209)):
            assert np.linalg.norm(uv - tip, axis=1).min() < 16


def test_a_cloud_becomes_a_closed_image():
    state = facing(**ARMS)
    depth = depth_of(BODY, state, CAMERA, noise=0.0)
    rows, columns = np.nonzero(depth)
    rays = np.moveaxis(CAMERA.ray_table, 0, -1)[rows, columns]
    z = depth[rows, columns]
    x = np.column_stack([rays * z[:, None], z]) @ CAMERA.T_world_camera[:3, :3].T + CAMERA.centre_world
    some = x[np.random.default_rng(0).permutation(len(x))[:2000]]
    coarse, small = splat(some, CAMERA)
    body = depth[tuple(np.clip(np.rint((np.indices(coarse.shape).reshape(2, -1).T + 0.5) * 240 / small.size[1] - 0.5)
                               .astype(int), 0, (239, 319)).T)].reshape(coarse.shape) > 0  # fmt: skip
    assert np.mean(coarse[body] > 0) > 0.6
    assert abs(np.median(coarse[coarse > 0]) - np.median(z)) < 0.02


def twin(score, state):
    """The score of one state in plain numpy."""
    view, mesh, tree = score.view, score.mesh, score.body.tree
    frames, _ = tree.forward(state.T_world_root, state.angles)
    x = mesh.posed(frames) @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
    h, w = view.observed.shape
    z = rasterise(x, mesh.faces, view.lens, (w, h)).depth.astype(float)
    drawn, seen = np.isfinite(z), view.seen
    gap = np.where(drawn & seen, z - view.observed, 0.0) / MAX_DEPTH_ERROR
    explained = np.sum(np.clip(1 - np.abs(gap), 0, 1)[drawn & seen])
    against = np.sum(np.clip(-0.5 * gap, 0, 1)) + np.sum(view.trust[drawn & ~seen & (z < view.behind)])
    odd = np.mean(((state.angles - tree.usual) / prior_sigmas(score.body)) ** 2)
    return (explained - against) / seen.sum() - POSTURE_COST * odd


def test_the_score_is_its_numpy_twin_and_truth_scores_best():
    state = facing(**ARMS)
    depth = depth_of(BODY, state, CAMERA)
    score = Score(BODY, view_of(depth, depth > 0, CAMERA))
    rng = np.random.default_rng(0)
    for _ in range(6):
        other = state.retract(0.05 * rng.normal(size=BODY.tree.n_dofs))
        within = twin(score, other) - score.of(other)
        assert 0.0 <= within + 1e-4 and within < OVERLAP_COST * 0.2  # what is left is parts within parts
        assert score.of(other) < score.of(state)
    assert score.of(state) > 0.85


def test_parts_that_stay_may_be_drawn_once():
    state = facing(**ARMS)
    depth = depth_of(BODY, state, CAMERA)
    score = Score(BODY, view_of(depth, depth > 0, CAMERA))
    limb = next(limb for limb in limbs(BODY) if BODY.tree.segments[limb[-1]] == "forearm_l")
    everything = tuple(range(len(BODY.tree.segments)))
    base = score.depth(state, tuple(s for s in everything if s not in limb))
    angles = np.repeat(state.angles[None], 5, axis=0)
    angles[:, BODY.tree.coordinate("elbow_flex_l")] = np.linspace(0, 2, 5)
    roots = np.repeat(state.T_world_root[None], 5, axis=0)
    assert np.allclose(score(roots, angles), score(roots, angles, everything, moving=limb, base=base), atol=1e-6)


def test_fingers_are_stretched_or_folded_as_they_explain_more():
    body = load_body("humanoid")
    angles = np.array(body.tree.usual)
    for name, value in ARMS.items():
        angles[body.tree.coordinate(name)] = np.radians(value)
    state = BodyState(facing().T_world_root, angles)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    mesh = body_mesh(body)
    fist = ~of_fingers(body, mesh.face_segment, mesh.vertices[mesh.faces].mean(axis=1))
    hand = [s for s, name in enumerate(body.tree.segments) if name == "hand_r"]
    seen = {}
    for name, faces in (("stretched", mesh.faces), ("fist", mesh.faces[fist])):
        depth = Canvas(CAMERA.size).draw_for(CAMERA, mesh.posed(frames), faces).depth
        depth = np.where(np.isfinite(depth), depth, 5.0)
        score = Score(body, view_of(depth, depth < 5.0, CAMERA))
        everything = tuple(range(len(body.tree.segments)))
        base = score.depth(state, tuple(s for s in everything if s not in hand))
        roots, angles = state.T_world_root[None], state.angles[None]
        parts = score(roots, angles, everything, moving=tuple(hand), base=base)
        assert np.allclose(score(roots, angles), parts, atol=0.01)  # folded fingers that hid other parts
        seen[name] = score, score.depth(state, everything)
    drawn = {name: int(np.isfinite(depth).sum()) for name, (_, depth) in seen.items()}
    assert drawn["fist"] < drawn["stretched"]
    assert seen["fist"][0].of(state) > seen["stretched"][0].of(state) - 0.01  # nothing is missing of either
    assert seen["fist"][0].missing(state) < 0.02 and seen["stretched"][0].missing(state) < 0.02


def test_a_limb_that_lies_elsewhere_is_missing():
    state = facing(**ARMS)
    depth = depth_of(BODY, state, CAMERA)
    score = Score(BODY, view_of(depth, depth > 0, CAMERA))
    angles = np.array(state.angles)
    angles[BODY.tree.coordinate("arm_add_l")] += 1.5
    assert score.missing(state) < 0.02
    assert score.missing(replace(state, angles=angles)) > 0.05


def test_limbs_reach_from_the_trunk_to_their_ends():
    names = {tuple(BODY.tree.segments[s] for s in limb) for limb in limbs(BODY)}
    assert ("upperarm_r", "forearm_r") in names and ("head",) in names and len(names) == 5


def test_meshes_serve_as_surfaces_too():
    state = facing(**ARMS)
    depth = depth_of(BODY, state, CAMERA)
    view = view_of(depth, depth > 0, CAMERA)
    torso = BODY.surfaces[0]
    mesh = MeshSurface(torso.segment, *triangles(torso))
    other = replace(BODY, surfaces=(mesh, *BODY.surfaces[1:]))
    assert abs(Score(other, view).of(state) - Score(BODY, view).of(state)) < 0.05
