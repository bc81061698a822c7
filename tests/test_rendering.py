"""The z-buffer against casting a ray through every pixel, one triangle at a time."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinefit.bodies import load_body
from kinefit.bodies.rendering import Canvas, in_camera, rasterise, render_body, scaled, subdivided
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera

NEAR = 0.05
LENS = (60.0, 55.0, 15.3, 11.7)
SIZE = (32, 24)


def cast(x, faces, fx, fy, cx, cy, size, near=NEAR):
    """Depth (H, W) and face (H, W) of rays through the pixels' centres (Möller-Trumbore), all float64."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
    depth, face = np.full(u.shape, np.inf), np.full(u.shape, -1)
    for t, (i, j, k) in enumerate(faces):
        e1, e2 = x[j] - x[i], x[k] - x[i]
        p = np.cross(rays, e2)
        det = p @ e1
        with np.errstate(all="ignore"):
            b = p @ -x[i] / det
            q = np.cross(-x[i], e1)
            c, z = rays @ q / det, (q @ e2) / det
        hit = (b >= 0) & (c >= 0) & (b + c <= 1) & (z >= near) & (z < depth)
        depth[hit], face[hit] = z[hit], t
    return depth, face


def sphere(around=24, radius=1.0, centre=(0.0, 0.0, 0.0)):
    """Vertices and outward faces; the poles are degenerate triangles on purpose."""
    polar, turn = np.linspace(0, np.pi, around // 2 + 1), np.arange(around) * 2 * np.pi / around
    x = np.stack([np.outer(np.sin(polar), np.cos(turn)), np.outer(np.sin(polar), np.sin(turn)),
                  np.outer(np.cos(polar), np.ones(around))], axis=-1).reshape(-1, 3)  # fmt: skip
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around // 2), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    return radius * x + np.array(centre), faces


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_triangles_are_as_rays_see_them(seed):
    """Also cut by the near plane, beside the image, behind the camera, through each other."""
    random = np.random.default_rng(seed)
    x = random.normal(size=(15, 3)) * 10 ** random.uniform(-1.5, 0.7) + [0, 0, random.uniform(-0.2, 2.0)]
    faces = random.integers(0, 15, (12, 3))
    raster = rasterise(x, faces, LENS, SIZE)
    depth, face = cast(x, faces, *LENS, SIZE)
    differ = raster.face != face
    for j, i in zip(*np.nonzero(differ)):  # only where a ray meets two at one depth, or an edge or plane by a hair
        pair = [f for f in (raster.face[j, i], face[j, i]) if f >= 0]
        moved = [cast(x, faces[pair], LENS[0], LENS[1], LENS[2] + d, LENS[3] + e, SIZE, NEAR * (1 + f))[1][j, i]
                 for d in (-1e-6, 1e-6) for e in (-1e-6, 1e-6) for f in (-1e-6, 1e-6)]  # fmt: skip
        close = len(pair) == 2 and abs(raster.depth[j, i] - depth[j, i]) < 1e-6 * depth[j, i]
        assert len(set(moved)) > 1 or close
    same = ~differ & raster.seen
    np.testing.assert_allclose(raster.depth[same], depth[same], rtol=2e-5)
    assert np.isinf(raster.depth[~raster.seen]).all()


def grid(columns, rows, points):
    """Faces of a grid of points, every cell two triangles cut one way or the other."""
    faces = []
    for j in range(rows - 1):
        for i in range(columns - 1):
            a, b, c, d = (j * columns + i, j * columns + i + 1, (j + 1) * columns + i, (j + 1) * columns + i + 1)
            faces += [(a, b, d), (a, d, c)] if (i + j) % 2 else [(a, b, c), (b, d, c)]
    return points, np.array(faces)


@pytest.mark.parametrize("whole_pixels", [True, False])
def test_neighbours_share_no_pixel_and_leave_none(whole_pixels):
    """Also where corners lie on the centres of pixels, and edges run through many."""
    random = np.random.default_rng(3)
    u, v = np.meshgrid(np.linspace(-4, 36, 11), np.linspace(-4, 28, 9))
    inner = (u > -4) & (u < 36) & (v > -4) & (v < 28)
    u, v = u + inner * random.uniform(-1.3, 1.3, u.shape), v + inner * random.uniform(-1.3, 1.3, v.shape)
    if whole_pixels:
        u, v = np.round(u), np.round(v)
    z = random.uniform(1.0, 3.0, u.shape)
    x, faces = grid(11, 9, np.stack([(u - 15) / 64 * z, (v - 11) / 64 * z, z], axis=-1).reshape(-1, 3))
    count = sum(rasterise(x, face[None], (64, 64, 15, 11), SIZE).seen.astype(int) for face in faces)
    assert (count == 1).all()


def test_depth_is_exact_on_a_slanted_plane():
    """1/z is linear in the image, z is not."""
    x = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 4.0], [1.0, 1.0, 4.0], [-1.0, 1.0, 1.0]]) * 3
    raster = rasterise(x, [[0, 1, 2], [0, 2, 3]], LENS, SIZE)
    ray = np.broadcast_to((np.arange(SIZE[0]) - LENS[2]) / LENS[0], raster.depth.shape)  # plane z = 7.5 + 1.5 x
    assert raster.seen.mean() > 0.7
    np.testing.assert_allclose(raster.depth[raster.seen], (7.5 / (1 - 1.5 * ray))[raster.seen], rtol=1e-6)


def test_what_is_turned_away_is_left_out():
    x, faces = sphere(centre=(0, 0, 3))
    whole, front = rasterise(x, faces, LENS, SIZE), rasterise(x, faces, LENS, SIZE, cull=True)
    np.testing.assert_array_equal(whole.face, front.face)
    inside = rasterise(x, faces[:, ::-1], LENS, SIZE, cull=True)
    assert inside.depth[12, 15] == pytest.approx(4.0, abs=0.05)
    assert whole.depth[12, 15] == pytest.approx(2.0, abs=0.05)


def test_nothing_without_an_inside_is_drawn():
    x = np.array([[0, 0, 1.0], [0.1, 0.1, 1.0], [0.2, 0.2, 1.0], [0, 0, 1.0], [0, 0, -1.0]])
    raster = rasterise(x, [[0, 1, 2], [0, 3, 1], [0, 0, 0], [4, 4, 4], [4, 4, 0]], LENS, SIZE)
    assert not raster.seen.any()
    assert not rasterise(np.empty((0, 3)), np.empty((0, 3), int), LENS, SIZE).seen.any()


def test_standing_within_a_sphere_leaves_no_hole():
    """The floor on which a camera lies, and all that reaches behind it, is cut and not lost."""
    x, faces = sphere(around=40, centre=(0.2, 0.1, 0.3))
    assert rasterise(x, faces, (20.0, 20.0, 15, 11), SIZE).seen.all()


@pytest.mark.parametrize(
    ("model", "distortion"), [("radtan", (-0.25, 0.08, 0.002, -0.001)), ("fisheye", (0.02, -0.01, 0.003, 0.0))]
)
def test_a_lens_bends_what_is_drawn(model, distortion):
    """Every pixel's ray, with its depth, ends on the surface."""
    T = np.eye(4)
    T[:3, 3] = 0.1, -0.2, 0.3
    camera = Camera("a", (160, 120), np.array([[90.0, 0.7, 80.0], [0, 92.0, 60.0], [0, 0, 1]]), distortion, model, T)
    x, faces = sphere(around=200, centre=(0.2, 0.3, 1.9))
    raster = Canvas(camera.size).draw_for(camera, x, faces, cull=True)
    assert raster.seen.mean() > 0.25
    a, b = camera.ray_table
    seen = np.stack([a, b, np.ones_like(a)], axis=-1)[raster.seen] * raster.depth[raster.seen][:, None]
    radius = np.linalg.norm(seen - T[:3, 3] - (0.2, 0.3, 1.9), axis=1)
    assert np.abs(radius - 1).max() < 2e-3
    wrong = np.linalg.norm(np.linalg.norm(in_camera(camera, x) - x - T[:3, 3], axis=1))
    assert wrong > 0.1  # a lens without effect would prove nothing


@dataclass
class Balls:
    """A stand-in for a body's mesh: a ball at every joint."""

    body: object

    def __post_init__(self):
        x, faces = sphere(around=20, radius=0.1)
        count = len(self.body.tree.segments)
        self.local, self.faces = x, np.concatenate([faces + k * len(x) for k in range(count)])
        self.face_segment = np.repeat(np.arange(count), len(faces))

    def posed(self, frames):
        """Vertices in the world."""
        joints = [f[:9].reshape(3, 3) @ rest + f[9:] for f, rest in zip(frames, self.body.tree.rest)]
        return np.concatenate([self.local + joint for joint in joints])


@pytest.fixture(scope="module")
def figure():
    body = load_body("humanoid10")
    T = np.array([[0.0, 0, 1, 0], [0, -1, 0, 0.1], [1, 0, 0, 3.0], [0, 0, 0, 1]])
    T[:3, :3] = T[:3, :3] * np.linalg.det(T[:3, :3])
    T[:3, :3] = [[0, 0, -1], [0, -1, 0], [-1, 0, 0]]  # looks along -x, up is up
    return body, Camera("a", (160, 120), np.array([[130.0, 0, 79.5], [0, 130, 59.5], [0, 0, 1]]), (), "radtan", T)


def test_a_body_shows_the_segments_where_they_are(figure):
    body, camera = figure
    state = body.default_state()
    raster = render_body(body, state, camera, mesh=Balls(body))
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    joints = np.array([f[:9].reshape(3, 3) @ rest + f[9:] for f, rest in zip(frames, body.tree.rest)])
    uv = np.round(camera.project(joints)).astype(int)
    assert raster.segment.dtype == np.int16
    assert (raster.segment[uv[:, 1], uv[:, 0]] == np.arange(len(joints))).mean() >= 0.8  # some hide others
    assert (raster.segment[~raster.seen] == -1).all()


def test_a_smaller_image_shows_the_same(figure):
    body, camera = figure
    mesh, state = Balls(body), body.default_state()
    small = render_body(body, state, camera, mesh=mesh, scale=0.25)
    assert small.face.shape == (30, 40)
    assert small.seen.mean() == pytest.approx(render_body(body, state, camera, mesh=mesh).seen.mean(), abs=0.005)
    canvas = Canvas((40, 30))
    again = render_body(body, state, camera, mesh=mesh, scale=0.25, canvas=canvas)
    np.testing.assert_array_equal(small.face, again.face)
    render_body(body, state, camera, mesh=mesh, scale=0.25, canvas=canvas)
    assert scaled(camera, 0.25).size == (40, 30)


def test_cutting_triangles_keeps_the_surface_whole():
    x, faces = sphere(around=8)
    fine, more = subdivided(x, faces, 0.2)

    def area(x, f):
        return 0.5 * np.linalg.norm(np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1).sum()

    assert area(fine, more) == pytest.approx(area(x, faces))
    edges = np.concatenate([more[:, [0, 1]], more[:, [1, 2]], more[:, [2, 0]]])
    assert np.linalg.norm(fine[edges[:, 0]] - fine[edges[:, 1]], axis=1).max() <= 0.2
    np.testing.assert_allclose(
        rasterise(fine + [0, 0, 3], more, LENS, SIZE).depth, rasterise(x + [0, 0, 3], faces, LENS, SIZE).depth,
        rtol=1e-6,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"vertices_camera": [[0, 0, 1], [1, 0, 1], [0, np.nan, 1]]}, "finite"),
        ({"faces": [[0, 1, 3]]}, "out of range"),
        ({"faces": [[0, 1, -1]]}, "out of range"),
        ({"faces": [0, 1, 2]}, "faces"),
        ({"vertices_camera": [[0, 0], [1, 0], [0, 1]]}, "vertices"),
        ({"size": (0, 4)}, "image"),
        ({"lens": (0.0, 9.0, 4.0, 4.0)}, "lens"),
        ({"lens": (9.0, 9.0, np.nan, 4.0)}, "lens"),
        ({"near": 0.0}, "lens"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, word):
    good = {"vertices_camera": [[0, 0, 1], [1, 0, 1], [0, 1, 1.0]], "faces": [[0, 1, 2]]}
    good |= {"lens": (9.0, 9.0, 4.0, 4.0), "size": (8, 8)}
    rasterise(**good)
    with pytest.raises(ObservationError, match=word):
        rasterise(**good | change)


def test_a_canvas_of_another_size_is_refused(figure):
    body, camera = figure
    with pytest.raises(ObservationError, match="canvas"):
        render_body(body, body.default_state(), camera, mesh=Balls(body), canvas=Canvas((8, 8)))
    with pytest.raises(ObservationError, match="scaled"):
        render_body(body, body.default_state(), camera, mesh=Balls(body), scale=0.0)
    with pytest.raises(ObservationError, match="labels"):
        _ = rasterise([[0, 0, 1], [1, 0, 1], [0, 1, 1.0]], [[0, 1, 2]], LENS, SIZE).segment
