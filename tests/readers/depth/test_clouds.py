"""PCD and PLY in all their kinds, cut and damaged ones too; the camera of an organised cloud."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import CalibrationError, FileError, KinefitError
from kinefit.readers.depth._kernels_clouds import lzf
from kinefit.readers.depth.clouds import camera_of, depth_of, read_cloud

RNG = np.random.default_rng(3)
POINTS = RNG.normal(size=(12, 3)).astype(np.float32)


def pack(data):
    """LZF: pieces seen before (3 to 264 bytes, up to 8191 back) are named, the rest stands as it is."""
    out, literal, i = b"", b"", 0
    def flush():
        nonlocal out, literal
        for k in range(0, len(literal), 32):
            piece = literal[k : k + 32]
            out += bytes([len(piece) - 1]) + piece
        literal = b""
    while i < len(data):
        best, back = 0, 0
        for start in range(max(i - 60, 0), i):
            n = 0
            while i + n < len(data) and n < 264 and data[start + n] == data[i + n]:
                n += 1
            if n > best:
                best, back = n, i - start - 1
        if best >= 3:
            flush()
            n = best - 2
            head = min(n, 7) << 5 | back >> 8
            out += bytes([head, *([n - 7] if n >= 7 else []), back & 255])
            i += best
        else:
            literal += data[i : i + 1]
            i += 1
    flush()
    return out


def pcd(kind, points=POINTS, width=None, viewpoint="0 0 0 1 0 0 0"):
    """A PCD with a colour between the coordinates, which readers must step over."""
    n, width = len(points), width or len(points)
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x rgb y z\nSIZE 4 1 4 4\nTYPE F U F F\nCOUNT 1 3 1 1\n"
        f"WIDTH {width}\nHEIGHT {n // width}\nVIEWPOINT {viewpoint}\nPOINTS {n}\nDATA {kind}\n"
    ).encode()
    x, y, z = points.astype("<f4").T
    if kind == "ascii":
        return head + "\n".join(f"{a:.9g} 1 2 3 {b:.9g} {c:.9g}" for a, b, c in zip(x, y, z)).encode() + b"\n"
    if kind == "binary":
        return head + b"".join(struct.pack("<f3B2f", a, 1, 2, 3, b, c) for a, b, c in zip(x, y, z))
    raw = x.tobytes() + bytes([1, 2, 3]) * n + y.tobytes() + z.tobytes()
    packed = pack(raw)
    return head + struct.pack("<2I", len(packed), len(raw)) + packed


def ply(kind, points=POINTS):
    head = (
        f"ply\nformat {kind} 1.0\ncomment made here\nelement vertex {len(points)}\nproperty double x\n"
        "property uchar red\nproperty float y\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    if kind == "ascii":
        rows = "\n".join(f"{a:.9g} 7 {b:.9g} {c:.9g}" for a, b, c in points)
        return head + rows.encode() + b"\n3 0 1 2\n"
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(f"{order}dBff", a, 7, b, c) for a, b, c in points.astype(float))
    return head + body + struct.pack(f"{order}B3i", 3, 0, 1, 2)


KINDS = [
    *((".pcd", pcd, kind) for kind in ("ascii", "binary", "binary_compressed")),
    *((".ply", ply, kind) for kind in ("ascii", "binary_little_endian", "binary_big_endian")),
]


@pytest.mark.parametrize(("ending", "make", "kind"), KINDS)
def test_every_kind_gives_its_points(tmp_path, ending, make, kind):
    (tmp_path / f"a{ending}").write_bytes(make(kind))
    cloud = read_cloud(tmp_path / f"a{ending}")
    np.testing.assert_allclose(cloud.points, POINTS, rtol=1e-6)
    assert cloud.shape is None
    np.testing.assert_array_equal(cloud.T_file_sensor, np.eye(4))


@pytest.mark.parametrize(("ending", "make", "kind"), KINDS)
def test_cut_anywhere_it_is_refused_and_never_crashes(tmp_path, ending, make, kind):
    data, file = make(kind), tmp_path / f"a{ending}"
    body = data.index(b"DATA" if ending == ".pcd" else b"end_header")
    for end in [*range(0, body, 7), *range(body, body + 30), len(data) - 60 if ending == ".ply" else len(data) - 20]:
        file.write_bytes(data[:end])
        with pytest.raises(FileError):
            read_cloud(file)


@pytest.mark.parametrize(
    "broken", [b"COUNT 1 3 1", b"TYPE F Q F F", b"WIDTH -12", b"VIEWPOINT 0 0 0 0 0 0 0", b"SIZE 4"]
)
def test_headers_that_cannot_be(tmp_path, broken):
    key = broken.split()[0]
    lines = [broken if line.startswith(key) else line for line in pcd("binary").split(b"\n", 11)]
    (tmp_path / "a.pcd").write_bytes(b"\n".join(lines))
    with pytest.raises(FileError):
        read_cloud(tmp_path / "a.pcd")


def test_what_is_no_cloud_says_so(tmp_path):
    (tmp_path / "a.pcd").write_bytes(b"hello")
    with pytest.raises(FileError, match="neither PCD nor PLY"):
        read_cloud(tmp_path / "a.pcd")
    (tmp_path / "b.pcd").write_bytes(pcd("binary").replace(b"FIELDS x rgb y z", b"FIELDS a rgb b c"))
    with pytest.raises(FileError, match="has no x, only a, rgb, b, c"):
        read_cloud(tmp_path / "b.pcd")
    with pytest.raises(FileError, match="no such file"):
        read_cloud(tmp_path / "nothing.pcd")


@given(st.binary(max_size=400), st.integers(1, 40))
def test_lzf_gives_back_what_was_packed(data, times):
    data = data * times
    out = np.empty(len(data), np.uint8)
    if len(data) < 3000:
        assert lzf(np.frombuffer(pack(data), np.uint8), out) == len(data)
        assert out.tobytes() == data


@given(st.binary(max_size=200), st.integers(0, 300))
def test_lzf_of_rubbish_stays_within_its_bounds(data, size):
    out = np.zeros(size + 8, np.uint8)
    assert -1 <= lzf(np.frombuffer(data, np.uint8), out[:size]) <= size
    assert (out[size:] == 0).all()


def grid(K, size, depth):
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([(u - K[2]) / K[0] * depth, (v - K[3]) / K[1] * depth, depth], axis=-1).reshape(-1, 3)


def test_an_organised_cloud_tells_its_camera_and_its_depth(tmp_path):
    depth = RNG.uniform(0.5, 4, (24, 32))
    depth[3, 4] = np.nan
    x = grid((30.0, 31.0, 15.2, 11.7), (32, 24), depth)
    turn = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)  # a sensor that stands in a room with z up
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, (1, 2, 3)
    quaternion = "0.5 -0.5 0.5 -0.5"
    data = pcd("binary", x @ turn.T + (1, 2, 3), width=32, viewpoint=f"1 2 3 {quaternion}")
    (tmp_path / "a.pcd").write_bytes(data)
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_allclose(cloud.T_file_sensor, T, atol=1e-9)
    camera = camera_of(cloud, "cam")
    np.testing.assert_allclose(camera.matrix, [[30, 0, 15.2], [0, 31, 11.7], [0, 0, 1]], atol=1e-3)
    np.testing.assert_allclose(depth_of(cloud), np.nan_to_num(depth), atol=1e-5)
    bent = x + RNG.normal(size=x.shape) * 0.2
    (tmp_path / "b.pcd").write_bytes(pcd("binary", bent, width=32))
    with pytest.raises(CalibrationError, match="pinhole"):
        camera_of(read_cloud(tmp_path / "b.pcd"), "cam")


def test_real_clouds(data_dir):
    folder = data_dir("depth_pcl_person")
    cloud = read_cloud(folder / "person.pcd")
    camera = camera_of(cloud, "kinect")
    np.testing.assert_allclose(camera.matrix, [[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]], atol=0.01)
    from kinefit.images.depth import to_points

    seen = cloud.points[np.isfinite(cloud.points).all(axis=1)]
    np.testing.assert_allclose(to_points(depth_of(cloud), camera), seen, atol=1e-5)
    model = read_cloud(folder / "model.pcd")
    assert model.points.shape == (100_000, 3) and model.shape is None and np.isfinite(model.points).all()


def test_errors_are_ours(tmp_path):
    for data in (b"ply\n", b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n", b"\x00FIELDS\n" * 3):
        (tmp_path / "a.ply").write_bytes(data)
        with pytest.raises(KinefitError):
            read_cloud(tmp_path / "a.ply")
