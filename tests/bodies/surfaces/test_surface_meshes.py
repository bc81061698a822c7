"""Meshes as surfaces: what is refused and why, files, units, mirrored limbs."""

import numpy as np
import pytest
from tests.bodies.surfaces.shapes import ball, box

from kinefit.bodies import load_body
from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.surfaces.mesh import mesh_surface, read_obj
from kinefit.errors import BodyError

V, F = box((0.3, 0.2, 0.1))
CUBE = "\n".join([f"v {x} {y} {z}" for x, y, z in V] + [f"f {a + 1}/1/2 {b + 1}//3 {c + 1}" for a, b, c in F])


def broken(change):
    vertices, faces = V.copy(), F.copy()
    return change(vertices, faces)


def not_finite(v, f):
    v[3, 1] = np.nan
    return v, f


def flipped(v, f):
    f[4] = f[4, ::-1]
    return v, f


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (not_finite, "vertex 3 .* not finite"),
        (lambda v, f: (v, f + 1), "out of range"),
        (lambda v, f: (v, f - 1), "out of range"),
        (lambda v, f: (v, f[:0]), "no faces"),
        (lambda v, f: (v[:, :2], f), "shape"),
        (lambda v, f: (v, f + 0.5), "float64 numbers"),
        (flipped, "opposite ways, at 3 edges"),
        (lambda v, f: (v, f[:, ::-1]), "inside out"),
        (lambda v, f: (v, f[2:]), r"hole of 0\.224 m near \[-0\.15.* \(4 open edges"),
        (lambda v, f: (1e-9 * v, f), "have no area"),
    ],
)
def test_what_no_surface_can_be_made_of_is_refused(change, says):
    with pytest.raises(BodyError, match=says) as caught:
        MeshSurface(0, *broken(change))
    assert caught.value.remedy


def test_a_hole_smaller_than_a_cell_is_let_pass_and_told():
    v, f = ball(0.1, around=160)
    with_hole = MeshSurface(0, v, f[1:])
    assert with_hole.open_edges == 3 and MeshSurface(0, v, f).open_edges == 0
    assert with_hole.grid.values[..., 0].min() == pytest.approx(-0.1, abs=0.006)
    np.testing.assert_allclose(with_hole.grid.values[..., 0], MeshSurface(0, v, f).grid.values[..., 0], atol=1e-3)


def test_corners_that_every_face_has_for_itself_count_as_shared():
    soup = MeshSurface(0, V[F].reshape(-1, 3), np.arange(3 * len(F)).reshape(-1, 3))
    assert soup.open_edges == 0
    np.testing.assert_allclose(soup.grid.values, MeshSurface(0, V, F).grid.values, atol=1e-6)


def test_arrays_are_kept_apart_and_cannot_be_written():
    v = V.copy()
    mesh = MeshSurface(0, v, F)
    v[:] = 0.0
    np.testing.assert_array_equal(mesh.vertices, V)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 0.0


def test_all_forms_of_faces(tmp_path):
    path = tmp_path / "box.obj"
    path.write_text(f"# made\no box\nvn 0 0 1\nusemtl skin\n{CUBE} # end\n")
    v, f = read_obj(path)
    np.testing.assert_allclose(v, V)
    np.testing.assert_array_equal(f, F)
    path.write_text("v 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\n")
    np.testing.assert_array_equal(read_obj(path)[1], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("v 0 0\n", "line 1.*not a line"), ("v 0 0 zero\n", "line 1"), ("v 0 0 0\nf 1 1 2\n", "line 2.*are not yet"),
        ("v 0 0 0\nf 1 1\n", "line 2"), ("v 0 0 0\nf 0 1 1\n", "line 2"), ("v 0 0 0\nf a b c\n", "line 2"),
        ("", "no faces"),
    ],
)
def test_bad_files_are_told_with_their_line(tmp_path, text, says):
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(BodyError, match=says) as caught:
        read_obj(path)
    assert caught.value.file == path and caught.value.remedy


def test_no_file(tmp_path):
    with pytest.raises(BodyError, match="cannot read"):
        read_obj(tmp_path / "none.obj")


def test_millimetres_taken_for_metres_are_noticed(tmp_path):
    path = tmp_path / "box.obj"
    faces = CUBE[CUBE.index("f ") :]
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in 1000 * V) + faces)
    with pytest.raises(BodyError, match='300 m long.*unit = "mm"'):
        mesh_surface(path, 0)
    np.testing.assert_allclose(mesh_surface(path, 0, unit="mm").vertices, V)
    with pytest.raises(BodyError, match="no unit 'yard'"):
        mesh_surface(path, 0, unit="yard")


BODY = """
[body]
name = "two"
mirror = true
[[segment]]
name = "trunk"
joint = { name = "root", type = "free" }
[[segment]]
name = "hand_r"
parent = "trunk"
joint = { name = "wrist_r", type = "fixed", at = [0.0, 0.0, 0.2] }
surface = { SURFACE }
"""


def test_a_body_file_names_its_meshes_beside_it(tmp_path):
    (tmp_path / "hand.obj").write_text(CUBE.replace("v -0.15 ", "v -0.25 "))
    (tmp_path / "two.toml").write_text(BODY.replace("SURFACE", 'mesh = "hand.obj"'))
    right, left = load_body(tmp_path / "two.toml").surfaces
    assert (right.segment, left.segment) == (1, 2) and right.vertices[:, 0].min() == -0.25
    np.testing.assert_allclose(left.vertices, right.vertices * [1, 1, -1])


@pytest.mark.parametrize(
    ("surface", "says"),
    [
        ('mesh = "none.obj"', "none.obj, surface of segment hand_r: cannot read the mesh"),
        ('mesh = "hand.obj", end = [0.0, 1.0, 0.0], radii = [0.1, 0.1]', "needs exactly one shape"),
        ("end = [0.0, 1.0, 0.0]", "needs exactly one shape"),
    ],
)
def test_a_surface_in_a_body_file_that_cannot_be(tmp_path, surface, says):
    (tmp_path / "two.toml").write_text(BODY.replace("SURFACE", surface))
    with pytest.raises(BodyError, match=says):
        load_body(tmp_path / "two.toml")


def test_a_body_is_stretched_with_its_mesh(tmp_path):
    (tmp_path / "hand.obj").write_text(CUBE)
    (tmp_path / "two.toml").write_text(BODY.replace("SURFACE", 'mesh = "hand.obj"'))
    body = load_body(tmp_path / "two.toml")
    larger = body.scaled(np.full(len(body.scale_groups), 2.0))
    np.testing.assert_allclose(larger.surfaces[0].vertices, 2.0 * V)
