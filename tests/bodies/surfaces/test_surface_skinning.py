"""Skins: blending, derivatives by all angles, joint lists, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import central_differences, random_body, slow_motions, state_of

from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.parts import without_part
from kinefit.bodies.surfaces import BodyMesh, SkinnedMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.bodies.surfaces.skins.skinning import strongest
from kinefit.errors import BodyError

random = np.random.default_rng(0)


def tube(body, segment, other, around=8, along=9):
    """A closed tube along two segments of an arm, and its weights: blended near the joint between them."""
    a, b = body.tree.segment(segment), body.tree.segment(other)
    length, angle = np.linspace(0.0, 0.5, along), 2 * np.pi * np.arange(around) / around
    rings = np.stack(np.broadcast_arrays(0.05 * np.cos(angle), -length[:, None], 0.05 * np.sin(angle)), -1)
    x = np.concatenate([rings.reshape(-1, 3), [[0, 0, 0], [0, -0.5, 0]]])
    j, rows = np.arange(around), np.arange(along - 1)[:, None] * around
    one, two, three, four = (np.ravel(rows + k) for k in (j, (j + 1) % around, around + (j + 1) % around, around + j))
    sides = np.concatenate([np.stack([one, two, three], 1), np.stack([one, three, four], 1)])
    end = len(x) - 2
    low, high = np.stack([0 * j + end, (j + 1) % around, j], 1), np.stack([0 * j + end + 1, j, (j + 1) % around], 1)
    high[:, 1:] += (along - 1) * around
    weights = np.zeros((len(x), len(body.tree.segments)))
    weights[:, b] = np.clip((-x[:, 1] - 0.24) / 0.1, 0.0, 1.0)
    weights[:, a] = 1.0 - weights[:, b]
    return x + body.tree.rest[a], np.concatenate([sides, low, high]), weights


@pytest.fixture(scope="module")
def arm():
    body = load_body("arm")
    x, faces, weights = tube(body, "upperarm_r", "forearm_r")
    return replace(body, skin=SkinnedMesh.of(x, faces, weights, body.tree))


def test_nodes_are_blended_between_segments(arm):
    state = state_of(arm, "random")
    T, skin = slow_motions(arm.tree, state), arm.skin
    x = np.c_[skin.vertices, np.ones(len(skin.vertices))]
    weights = np.zeros((len(x), len(T)))
    np.put_along_axis(weights, skin.owners.astype(int), skin.weights, 1)
    expected = np.einsum("vs,sij,vj->vi", weights, T, x)[:, :3]
    frames, _ = arm.tree.forward(state.T_world_root, state.angles)
    np.testing.assert_allclose(skin.posed(frames), expected, atol=1e-12)
    np.testing.assert_allclose(Morphing(arm).pose(state).vertices, expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["random", "identity", "near identity", "near pi"])
def test_derivatives_by_all_angles(arm, kind):
    state, morphing = state_of(arm, kind), Morphing(arm)
    nodes = np.arange(len(arm.skin.vertices))
    expected = central_differences(lambda s: morphing.pose(s).vertices, arm, state)
    np.testing.assert_allclose(morphing.pose(state).jacobian(nodes), expected, atol=2e-8)


def test_points_between_nodes_move_as_their_parts(arm):
    pose = Morphing(arm).pose(state_of(arm, "random"))
    faces, share = arm.skin.faces[:20], random.dirichlet(np.ones(3), 20)
    n = random.normal(size=(20, 3))
    expected = np.einsum("nc,ni,ncik->nk", share, n, pose.jacobian(faces.ravel()).reshape(20, 3, 3, -1))
    np.testing.assert_allclose(pose.along(faces, n, share), expected, atol=1e-12)
    with pytest.raises(BodyError, match="beyond the 74"):
        pose.along([len(arm.skin.nodes)], n[:1])
    with pytest.raises(BodyError, match="with shares"):
        pose.along(faces, n, share[:, :2])


def test_one_owner_is_the_body_mesh():
    body = random_body(3, 8)
    owner = np.sort(random.integers(0, 8, 50)).astype(np.int32)
    mesh = BodyMesh(random.normal(size=(50, 3)), np.array([[0, 1, 2]], np.int32), owner, owner[:1])
    skin, state = SkinnedMesh.of_mesh(mesh), state_of(body, "random")
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    np.testing.assert_allclose(skin.posed(frames), mesh.posed(frames), atol=1e-13)
    np.testing.assert_array_equal(skin.segment, owner)


def test_a_joint_list_names_what_moves_a_node(arm):
    """P1 2.4: a node of the forearm has the joints of shoulder and elbow, one of the upper arm the shoulder only."""
    names = lambda node: [arm.tree.coordinates[k] for k in arm.skin.joint_list(node, arm.tree)]
    first, last = 0, len(arm.skin.vertices) - 1
    assert names(first) == ["arm_flex_r", "arm_add_r", "arm_rot_r"]
    assert names(last) == ["arm_flex_r", "arm_add_r", "arm_rot_r", "elbow_flex_r", "pro_sup_r"]
    J = Morphing(arm).pose(state_of(arm, "random")).jacobian([first, last])
    moving = [np.flatnonzero(np.abs(j[:, 6:]).max(0) > 1e-9) for j in J]
    assert all(set(m) <= set(arm.skin.joint_list(k, arm.tree)) for m, k in zip(moving, (first, last)))


def test_faces_belong_to_the_segment_of_most_corners(arm):
    skin, owner = arm.skin, arm.skin.segment
    for face, segment in zip(skin.faces, skin.face_segment):
        assert np.sum(owner[face] == segment) >= 2


def test_a_skin_is_stretched_with_its_body(arm):
    scales = np.ones(len(arm.scale_groups))
    scales[arm.scale_groups.index("upperarm")] = 1.2
    large = arm.scaled(scales)
    grown = np.ptp(large.skin.vertices[:, 1]) - np.ptp(arm.skin.vertices[:, 1])
    assert grown == pytest.approx(0.2 * 0.29, abs=1e-9)
    twice = arm.scaled(np.full(len(scales), 2.0))
    np.testing.assert_allclose(twice.skin.vertices, 2 * arm.skin.vertices, atol=1e-12)


def test_only_the_strongest_owners_are_kept():
    weights = np.array([[0.5, 0.3, 0.15, 0.05], [0.0, 0.0, 1.0, 0.0]])
    owners, share = strongest(weights, 2)
    np.testing.assert_allclose(share, [[0.625, 0.375], [1.0, 0.0]])
    assert owners[0].tolist() == [0, 1] and owners[1, 0] == 2


def test_a_part_of_a_skinned_body_stays(arm):
    with pytest.raises(BodyError, match="keeps its parts"):
        without_part(arm, "hand_r")


def spoilt(body, **changes):
    x, faces, weights = tube(body, "upperarm_r", "forearm_r")
    given = {"x": x, "faces": faces, "weights": weights}
    given |= {name: change(given[name]) for name, change in changes.items()}
    return SkinnedMesh.of(given["x"], given["faces"], given["weights"], body.tree)


def flipped(faces):
    return np.concatenate([faces[:5, ::-1], faces[5:]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": lambda w: 0.9 * w}, "do not sum to one.*node 0.*Normalize All"),
        ({"weights": lambda w: w - 0.1}, "do not sum to one or are below zero"),
        ({"weights": lambda w: np.where(w > 0.5, np.nan, w)}, "do not sum to one"),
        ({"weights": lambda w: w[:, :-1]}, "for 4 segments"),
        ({"faces": flipped}, "face opposite ways"),
        ({"faces": lambda f: f[:, ::-1]}, "inside out"),
        ({"faces": lambda f: f[:-8]}, "a hole of"),
        ({"faces": lambda f: f + 1}, "of others"),
        ({"x": lambda x: np.where(x < -0.49, np.nan, x)}, "is not finite"),
    ],
)
def test_bad_skins_are_told(changes, message):
    with pytest.raises(BodyError, match=message):
        spoilt(load_body("arm"), **changes)


def test_a_skin_of_another_body_is_told(arm):
    owners = np.full(arm.skin.owners.shape, 9)
    with pytest.raises(BodyError, match="a skin with segment 9"):
        Morphing(arm, SkinnedMesh(arm.skin.nodes, arm.skin.faces, owners, arm.skin.weights))


def test_catalogue_bodies_are_closed_meshes():
    for name in ("humanoid", "humanoid10", "arm", "humanoid_morphing"):
        mesh = body_mesh(load_body(name))
        edges = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, 1)], 2).reshape(-1, 2), 1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def written(folder, body, x, faces, weights, unit="mm"):
    """A body file with a skin beside it."""
    lines = [f"v {a} {b} {c}" for a, b, c in 1000 * x] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (folder / "skin.obj").write_text("\n".join(lines))
    rows = [f"{v + 1},{body.tree.segments[s]},{weights[v, s]}" for v, s in zip(*np.nonzero(weights))]
    (folder / "skin.csv").write_text("\n".join(["vertex,segment,weight", *rows]))
    skin = f'[skin]\nmesh = "skin.obj"\nweights = "skin.csv"\nunit = "{unit}"\n'
    (folder / "arm.toml").write_text(f'[body]\nname = "skinned"\nbase = "arm"\n{skin}')
    return folder / "arm.toml"


def test_a_body_file_may_have_a_skin(arm, tmp_path):
    x, faces, weights = tube(arm, "upperarm_r", "forearm_r")
    body, state = load_body(written(tmp_path, arm, x, faces, weights)), state_of(arm, "random")
    np.testing.assert_allclose(
        Morphing(body).pose(state).vertices, Morphing(arm).pose(state).vertices, atol=1e-9
    )
    text = (tmp_path / "skin.csv").read_text().splitlines()
    owners = [line.rpartition(",")[0] for line in text if line.endswith(",1.0")]
    assert owners
    (tmp_path / "skin.csv").write_text("\n".join(line.removesuffix(",1.0") for line in text))  # joint lists
    np.testing.assert_array_equal(load_body(tmp_path / "arm.toml").skin.weights, body.skin.weights)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("2,upperarm_r,1.0", "2,upperarm_r,0.5", r"skin.csv, skin: weights of 1 nodes.*node 1"),
        ("2,upperarm_r,1.0", "2,upper,1.0", r"skin.csv, skin, line 3: no segment 'upper'"),
        ("2,upperarm_r,1.0", "1,upperarm_r,1.0", r"line 3: vertex 1 of 74 twice"),
        ("2,upperarm_r,1.0", "200,upperarm_r,1.0", r"line 3: vertex 200 of 74 is not there"),
        ("2,upperarm_r,1.0", "two,upperarm_r", r"line 3: not a weight: 'two,upperarm_r'"),
        ("2,upperarm_r,1.0", "", r"weights of 1 nodes"),
    ],
)
def test_bad_weights_of_a_file_are_told(arm, tmp_path, old, new, message):
    path = written(tmp_path, arm, *tube(arm, "upperarm_r", "forearm_r"))
    text = (tmp_path / "skin.csv").read_text()
    assert old in text
    (tmp_path / "skin.csv").write_text(text.replace(old, new, 1))
    with pytest.raises(BodyError, match=message):
        load_body(path)


def test_bad_skins_of_a_file_are_told(arm, tmp_path):
    x, faces, weights = tube(arm, "upperarm_r", "forearm_r")
    for shape, unit, message in (
        (flipped(faces), "mm", "skin.obj, skin: .*opposite ways"),
        (faces[:-8], "mm", "skin.obj, skin: .*hole"),
        (faces, "yard", "no unit 'yard'"),
        (faces, "m", "m long.*unit"),
    ):
        path = written(tmp_path, arm, x, shape, weights, unit)
        with pytest.raises(BodyError, match=message):
            load_body(path)
    path = written(tmp_path, arm, x, faces, weights)
    (tmp_path / "skin.csv").unlink()
    with pytest.raises(BodyError, match="cannot read the weights"):
        load_body(path)
