"""Morphs in body files: read, mirrored, written and read again; bodies told as a change of others."""

from dataclasses import replace

import numpy as np
import pytest
from tests.docs.blocks import blocks

from kinefit.bodies import BodyState, load_body, parse_body, save_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import GlobalMorph, JointMotion, LocalMorph, SegmentMorph, Steering
from kinefit.bodies.parts import without_part
from kinefit.bodies.serial import body_from_arrays, body_to_arrays
from kinefit.bodies.surfaces import SkinnedMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import BodyError, ExportError

OWN = """
[body]
name = "own"
base = "humanoid"

[[morph]]
kind = "joint"
segment = "upperarm_r"
shift = [0.03, -0.04, -0.01]
turn = [5, 0, 0]
angle = "arm_add_r"
start = -10
end = -100

[[morph]]
kind = "surface"
segment = "upperarm_r"
surface = { end = [0.0, -0.29, 0.0], radii = [[0.06, 0.05], 0.042] }
angle = "elbow_flex_r"
start = 20
end = 120
weight = [[0.0, 1.0], [0.5, 0.2], [1.0, 0.0]]

[[morph]]
kind = "local"
segment = "thorax"
centre = [0.1, 0.1, 0.08]
radii = [0.1, inf, 0.1]
shift = [0.01, 0.0, 0.005]
tilt = [0, 0, 20]
turn = [10, 30, 0]
stretch = [1.5, 1.0, 0.5]
on = ["thorax"]
angle = "arm_flex_r"
start = 0
end = 90
beyond = true
"""


def posed(body, **degrees):
    angles = body.rest_state().angles.copy()
    for name, value in degrees.items():
        angles[body.tree.coordinate(name)] = np.radians(value)
    return Morphing(body).pose(BodyState(np.eye(4), angles))


def test_a_morph_is_what_its_file_says():
    body = parse_body(OWN)
    motion, image, muscle, _, bulge, _ = body.morphs
    assert isinstance(motion, JointMotion) and motion.steering.coordinate == "arm_add_r"
    assert np.allclose([motion.steering.start, motion.steering.end], np.radians([-10, -100]))
    shoulder = body.tree.segment("upperarm_r")
    moved = posed(body, arm_add_r=-100)
    joint = moved.frames[shoulder, :9].reshape(3, 3) @ body.tree.rest[shoulder] + moved.frames[shoulder, 9:]
    np.testing.assert_allclose(joint, body.tree.rest[shoulder] + [0.03, -0.04, -0.01], atol=1e-12)
    assert (image.segment, image.steering.coordinate) == ("upperarm_l", "arm_add_l")
    assert muscle.surfaces[0].radii == ((0.06, 0.05), (0.042, 0.042))
    assert bulge.on == ("thorax",) and bulge.steering.beyond and bulge.stretch == (1.5, 1.0, 0.5)
    np.testing.assert_allclose(np.degrees([bulge.tilt, bulge.turn]), [[0, 0, 20], [10, 30, 0]], atol=1e-12)
    assert (body.name, body.stature, len(body.tree.coordinates)) == ("own", 1.75, 41)


def test_left_and_right_are_images_of_each_other():
    body = parse_body(OWN)
    poses = ["arm_add", "arm_flex", "elbow_flex"], [-70.0, 40.0, 90.0]
    right, left = (posed(body, **{f"{n}_{side}": v for n, v in zip(*poses)}) for side in "rl")
    a, b = (p.frames[body.tree.segment(f"hand_{s}")] for p, s in ((right, "r"), (left, "l")))
    mirror = np.diag([1.0, 1.0, -1.0])
    np.testing.assert_allclose(mirror @ a[9:], b[9:], atol=1e-12)
    np.testing.assert_allclose(mirror @ a[:9].reshape(3, 3) @ mirror, b[:9].reshape(3, 3), atol=1e-12)
    sides = (np.isin(right.morphing.mesh.segment, [body.tree.segment(f"{n}_{s}") for n in ("upperarm", "clavicle")])
             for s in "rl")  # fmt: skip
    heights = [np.sort(p.vertices[own, 1]) for p, own in zip((right, left), sides)]
    np.testing.assert_allclose(*heights, atol=1e-12)


def test_a_muscle_takes_its_second_shape():
    body = parse_body(OWN)
    thick = replace(
        body, morphs=(), surfaces=tuple(replace(s, radii=((0.06, 0.05), (0.042, 0.042)))
        if s.segment == body.tree.segment("upperarm_r") else s for s in body.surfaces)
    )  # fmt: skip
    found = posed(body, elbow_flex_r=120)
    np.testing.assert_allclose(found.vertices, posed(thick, elbow_flex_r=120).vertices, atol=1e-12)
    half = posed(body, elbow_flex_r=70)  # the table says 0.2 of the first shape at half of the way
    np.testing.assert_allclose(half.nodes - half.morphing.mesh.vertices, 0.8 * found.shift, atol=1e-12)


def test_a_whole_surface_as_the_target(tmp_path):
    body = load_body("arm")
    mesh = body_mesh(body)
    lines = [f"v {x} {y} {z}" for x, y, z in 1000 * (mesh.vertices + [0.0, 0.0, 0.01])]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    (tmp_path / "raised.obj").write_text("\n".join(lines))
    entry = 'kind = "global"\ntarget = "raised.obj"\nunit = "mm"\nangle = "arm_flex_r"\nstart = 0\nend = 90\n'
    (tmp_path / "arm.toml").write_text(f'[body]\nname = "blending"\nbase = "arm"\n[[morph]]\n{entry}')
    pose = posed(load_body(tmp_path / "arm.toml"), arm_flex_r=45)
    np.testing.assert_allclose(pose.nodes - mesh.vertices, np.tile([0, 0, 0.005], (len(mesh.vertices), 1)), atol=1e-9)
    (tmp_path / "raised.obj").write_text("\n".join(lines[1:-4]))
    with pytest.raises(BodyError, match="topology|are not yet defined"):
        posed(load_body(tmp_path / "arm.toml"))


def test_the_shoulder_of_the_catalogue_sinks_and_comes_forward():
    """P1 figures 10 and 11: down with the arm, forwards with the arm, both at once; the skin about it goes along."""
    body = load_body("humanoid_morphing")
    s = body.tree.segment("upperarm_r")

    def centre(**degrees):
        pose = posed(body, **degrees)
        return pose.frames[s, :9].reshape(3, 3) @ body.tree.rest[s] + pose.frames[s, 9:], pose

    hanging, still = centre()
    raised, _ = centre(arm_add_r=-140)
    forward, _ = centre(arm_flex_r=105)
    both, _ = centre(arm_add_r=-140, arm_flex_r=105)
    np.testing.assert_allclose(raised - hanging, [0.0, 0.05, -0.02], atol=1e-12)
    np.testing.assert_allclose(forward - hanging, [0.03, 0.02, -0.01], atol=1e-12)
    np.testing.assert_allclose(both - hanging, [0.03, 0.07, -0.03], atol=1e-12)
    np.testing.assert_allclose(still.vertices, Morphing(body, operators=[]).pose(still.state).vertices, atol=1e-12)
    _, pose = centre(arm_add_r=-140)
    patch = np.linalg.norm(pose.morphing.mesh.vertices - hanging, axis=1) < 0.06
    patch &= pose.morphing.mesh.segment == body.tree.segment("clavicle_r")
    assert patch.any() and (pose.vertices - still.vertices)[patch, 1].min() > 0.03
    plain = replace(body, morphs=())
    np.testing.assert_allclose(posed(plain, arm_add_r=-140).frames[s, 9:], plain_frame(plain, s), atol=1e-12)


def plain_frame(body, segment):
    angles = body.rest_state().angles.copy()
    angles[body.tree.coordinate("arm_add_r")] = np.radians(-140)
    return body.tree.forward(np.eye(4), angles)[0][segment, 9:]


def test_morphs_are_stretched_with_their_body():
    """A body twice as large in all its lengths moves twice as far."""
    body = parse_body(OWN)
    large = body.scaled(np.full(len(body.scale_groups), 2.0))
    angles = {"arm_add_r": -80, "arm_flex_r": 40, "elbow_flex_r": 60}
    np.testing.assert_allclose(posed(large, **angles).vertices, 2.0 * posed(body, **angles).vertices, atol=1e-12)
    target = GlobalMorph(body_mesh(body).vertices, Steering("arm_add_r"))
    with pytest.raises(BodyError, match="single nodes"):
        replace(body, morphs=(target,)).scaled(np.full(len(body.scale_groups), 2.0))


def test_a_part_goes_with_its_morphs():
    body = parse_body(OWN)
    for name in ("hand_r", "forearm_r"):  # which bears the angle that steers the muscle
        body = without_part(body, name)
    kinds = [type(m) for m in body.morphs if m.steering.coordinate.endswith("_r")]
    assert kinds == [JointMotion, LocalMorph] and sum(isinstance(m, SegmentMorph) for m in body.morphs) == 1
    Morphing(body).pose(body.default_state())


def test_the_docs_example_is_a_body():
    example, tendon = (block.text for block in blocks("morphing", "toml")[:2])
    assert [type(m) for m in parse_body(example).morphs] == [LocalMorph, JointMotion]
    (found,) = parse_body(f'[body]\nname = "t"\nbase = "arm"\n{tendon}').morphs
    assert found.deforms and found.moves
    rest = np.abs(posed(replace(load_body("arm"), morphs=(found,)), elbow_flex_r=100).shift).max()
    assert 0.005 < rest < 0.012  # of the 1 cm stated


def change(old, new):
    assert old in OWN
    return OWN.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (change('angle = "arm_add_r"', 'angle = "arm"'), "joint morph of upperarm_r by arm.*no angle 'arm'"),
        (change('segment = "upperarm_r"', 'segment = "upper"'), "no segment 'upper'"),
        (change('segment = "upperarm_r"', 'segment = "pelvis"'), "the root has no joint"),
        (change('on = ["thorax"]', 'on = ["chest"]'), "no segment 'chest'"),
        (change('kind = "joint"', 'kind = "joints"'), "no kind of morph 'joints'"),
        (change("shift = [0.03, -0.04, -0.01]\nturn = [5, 0, 0]\n", ""), "moves nothing"),
        (change("turn = [5, 0, 0]", "radii = [1, 1, 1]"), "a joint morph has no radii"),
        (change("centre = [0.1, 0.1, 0.08]\n", ""), "a local morph without centre"),
        (change("radii = [0.1, inf, 0.1]", "radii = [0.1, 0.0, 0.1]"), "radii .* of a bulge"),
        (change("radii = [0.1, inf, 0.1]", "radii = [0.1, nan, 0.1]"), "radii .* of a bulge"),
        (change("shift = [0.01, 0.0, 0.005]", "shift = [nan, 0.0, 0.005]"), "`shift` is not finite"),
        (change("stretch = [1.5, 1.0, 0.5]", "stretch = [1.5, 0.0, 0.5]"), "local morph of thorax.*`stretch` above 0"),
        (change("tilt = [0, 0, 20]", "tilt = [0, inf, 20]"), "a bulge with tilt"),
        (change('kind = "surface"\n', 'kind = "surface"\ntilt = [0, 0, 1]\n'), "a surface morph has no tilt"),
        (change("end = -100", "end = -10"), "steered by arm_add_r from"),
        (change("weight = [[0.0, 1.0], [0.5, 0.2], [1.0, 0.0]]", 'weight = "cubic"'), "no weighting 'cubic'"),
        (change("[0.5, 0.2], [1.0, 0.0]]", "[0.5, 0.2]]"), r"ω\(0\) = 1.0 and ω\(1\) = 0.2"),
        (change("beyond = true", 'beyond = true\nweight = "sqrt"'), "must be linear"),
        (change("0.042] }", "-0.042] }"), "surface: a cylinder from"),
        (change('kind = "surface"', 'kind = "global"'), "a global morph without target"),
        (change('base = "humanoid"', 'base = "humanoids"'), "body.base: no body in the catalogue"),
        (change("end = -100", "end = -100\nspeed = 3"), "not a body file.*speed"),
    ],
)
def test_bad_morphs_are_told(text, message):
    with pytest.raises(BodyError, match=message):
        parse_body(text, "own.toml")


def test_arrays_hold_morphs_and_skins_exactly():
    """What a motion file keeps of a body."""
    body = parse_body(OWN)
    mesh, steering = body_mesh(body), Steering("arm_rot_l", 0.0, 1.0, lambda t: np.cos(np.pi * t / 2))
    body = replace(body, morphs=(*body.morphs, GlobalMorph(mesh.vertices + 0.01, steering)))
    back = body_from_arrays(body_to_arrays(body))
    turned = {"arm_add_r": -70, "arm_flex_r": 50, "elbow_flex_r": 80, "arm_add_l": -30, "arm_rot_l": 20}
    np.testing.assert_allclose(posed(back, **turned).vertices, posed(body, **turned).vertices, atol=1e-7)
    skinned = replace(body, skin=SkinnedMesh.of_mesh(mesh), morphs=())
    again = body_from_arrays(body_to_arrays(skinned))
    np.testing.assert_array_equal(posed(again, **turned).vertices, posed(skinned, **turned).vertices)
    assert body_from_arrays(body_to_arrays(replace(body, morphs=()))).skin is None


def test_a_saved_body_is_loaded_by_its_path(tmp_path):
    body = replace(parse_body(OWN), skin=SkinnedMesh.of_mesh(body_mesh(load_body("humanoid"))))
    save_body(body, tmp_path / "new" / "person.npz")
    back = load_body(tmp_path / "new" / "person.npz")
    assert back.name == "own" and len(back.morphs) == len(body.morphs)
    np.testing.assert_array_equal(back.skin.nodes, body.skin.nodes)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["person.npz"]
    with pytest.raises(BodyError, match="Call it person.npz"):
        save_body(body, tmp_path / "person.toml")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ExportError, match="cannot be written"):
        save_body(body, tmp_path / "file" / "person.npz")
    for content in (b"", b"not an archive", (tmp_path / "new" / "person.npz").read_bytes()[:2000]):
        (tmp_path / "spoilt.npz").write_bytes(content)
        with pytest.raises(BodyError, match="spoilt.npz.*damaged.*save_body"):
            load_body(tmp_path / "spoilt.npz")
    np.savez(tmp_path / "other.npz", x=1)
    with pytest.raises(BodyError, match="other.npz.*no array 'segments'"):
        load_body(tmp_path / "other.npz")
    with pytest.raises(BodyError, match="absent.npz: no such file"):
        load_body(tmp_path / "absent.npz")


def test_spoilt_arrays_are_told():
    body = replace(parse_body(OWN), skin=SkinnedMesh.of_mesh(body_mesh(load_body("humanoid"))))
    arrays = body_to_arrays(body)
    for change, message in (
        ({"morphs/0/kind": np.array("joints")}, "unknown kind 'joints'"),
        ({"morphs/0/span": np.zeros(3)}, "arrays of morph 0"),
        ({"skin/owners": arrays["skin/owners"] + 50}, "array 'skin/owners' has an index out of range.*0 to 19"),
        ({"skin/faces": None}, "no array 'skin/faces'"),
    ):
        spoilt = {key: array for key, array in (arrays | change).items() if array is not None}
        with pytest.raises(BodyError, match=message):
            body_from_arrays(spoilt)


def test_bases_do_not_go_round(tmp_path):
    for name, base in (("a", "b"), ("b", "a")):
        (tmp_path / f"{name}.toml").write_text(f'[body]\nname = "{name}"\nbase = "{base}.toml"\n')
    with pytest.raises(BodyError, match="form a cycle"):
        load_body(tmp_path / "a.toml")


def test_shoulders_with_joints_of_their_own_carry_their_bulges():
    """P1 3.3: up and down, forward and back, both at once, about the collar bone; a file and its copies agree."""
    body = load_body("humanoid_shoulders")
    tree, mesh = body.tree, Morphing(body).mesh
    trunk = mesh.segment == tree.segment("thorax")
    rest = posed(body).vertices
    found = {name: posed(body, **angles).vertices - rest for name, angles in {
        "up": {"clav_elev_r": 20}, "down": {"clav_elev_r": -10}, "forward": {"clav_prot_r": 20},
        "back": {"clav_prot_r": -15}, "both": {"clav_elev_r": 20, "clav_prot_r": 20}}.items()}  # fmt: skip
    for axis, ahead, against in ((1, "up", "down"), (0, "forward", "back")):
        assert found[ahead][trunk, axis].max() > 0.005 and found[against][trunk, axis].min() < -0.003
        assert np.abs(found[ahead][trunk & (rest[:, 2] < -0.1)]).max() < 1e-4  # nothing on the other side
    assert min(found["both"][trunk, k].max() for k in (0, 1)) > 0.005
    raised, held = (posed(replace(body, morphs=tuple(replace(m, moves=moves) for m in body.morphs)), clav_elev_r=40)
                    for moves in (True, False))  # fmt: skip
    apart = np.linalg.norm(raised.vertices - held.vertices, axis=1)
    assert apart[trunk].max() > 0.003 and apart[~trunk].max() == 0.0
    again, angles = body_from_arrays(body_to_arrays(body)), {"clav_elev_l": 25, "clav_prot_r": 10}
    np.testing.assert_allclose(posed(again, **angles).vertices, posed(body, **angles).vertices, atol=1e-9)
