"""Files that once raised untyped errors, were accepted with NaN, or took time and memory beyond all measure."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from benchmarks.robustness.fuzz.fuzz_seeds_folders import packed_glb
from benchmarks.scenes.bags import START, Bag

import kinefit
from kinefit._files import read_bytes, repeated
from kinefit.bodies import load_body
from kinefit.bodies.serial import body_to_arrays
from kinefit.errors import BodyError, FileError, ObservationError
from kinefit.observations import Detections
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.landmarks.annotations import Clicks, read_clicks
from kinefit.readers.ros import recordings
from kinefit.readers.ros.images import shown
from kinefit.readers.skeletons.characters import _order, read_character, read_gltf
from kinefit.readers.videos.video import Video


def test_no_pattern_at_the_start_of_lines_runs_over_lines():
    """Tried at every line, it would take time with the square of the blank lines."""
    source = Path(kinefit.__file__).parent
    at_fault = [file for file in source.rglob("*.py") if re.search(r'["\'(|]\^\\s[*+].*re\.M', file.read_text("utf-8"))]
    assert not at_fault


@pytest.mark.parametrize(
    ("stamps", "told"),
    [([0, 0, 0, 0], "a median step of 0 s"), ([0, 0, 0, 10**8], "a median step of 0 s"),
     ([*range(0, 100_000, 2000), 4 * 10**8], "come in bursts")],
)  # fmt: skip
def test_images_of_a_recording_at_one_time_are_told(tmp_path, stamps, told):
    pytest.importorskip("rosbags.rosbag2")
    pytest.importorskip("mcap_ros2")
    bag, image = Bag(), np.zeros((4, 4, 3), np.uint8)
    bag.messages = [("/a/image", bag.image("rgb8", image, 0), START + ns) for ns in stamps]
    file = bag.write(tmp_path / "bag")
    with pytest.raises(ObservationError, match=told) as error:
        Video(file)
    assert "/a/image" in error.value.problem and error.value.file == file and error.value.remedy
    if "median" in told:
        with pytest.raises(ObservationError, match=told):
            shown(file)


@pytest.mark.parametrize("size", [0, 1, 200, 255, 256, 300, 65_791, 65_792, 10**6])
def test_a_frame_of_zstandard_states_its_size(size):
    zstandard = pytest.importorskip("zstandard")
    frame = zstandard.compress(np.random.default_rng(0).bytes(size))
    assert recordings._zstd_size(frame + bytes(18)) == size
    assert recordings._zstd_size(frame[:10]) == recordings._zstd_size(b"text" * 9) == 0


@pytest.mark.parametrize("way", ["as stated", "stated too small", "without an index"])
def test_chunks_that_unpack_to_more_than_any_recorder_writes_are_not_unpacked(tmp_path, monkeypatch, way):
    writer = pytest.importorskip("mcap.writer")
    with (tmp_path / "a.mcap").open("wb") as file:
        indexes = writer.IndexType.NONE if way == "without an index" else writer.IndexType.ALL
        out = writer.Writer(file, compression=writer.CompressionType.ZSTD, index_types=indexes)
        out.start("ros2")
        channel = out.register_channel("/a", "cdr", out.register_schema("a", "ros2msg", b""))
        out.add_message(channel, 1, bytes(500_000), 1)
        out.finish()
    data = (tmp_path / "a.mcap").read_bytes()
    if way == "stated too small":
        size = data.index(b"zstd") - 16
        data = data[:size] + struct.pack("<Q", 10) + data[size + 8 :]
    assert len(data) < 5000
    (tmp_path / "a.mcap").write_bytes(data)
    monkeypatch.setattr(recordings, "_MAX_CHUNK_BYTES", 400_000)
    for module in ("mcap.reader", "mcap.stream_reader"):
        monkeypatch.setattr(f"{module}.breakup_chunk", lambda *_, **__: pytest.fail("it is unpacked"))
    with pytest.raises(FileError, match="a chunk of 1 MB, more than 0 MB"):
        Video(tmp_path / "a.mcap")


TIMES = [(["a", "b"], "type <U1"), ([[0.0], [1.0]], r"\(2, 1\) times for 2 frames")]


@pytest.mark.parametrize(("times", "told"), TIMES)
def test_times_of_depth_that_are_none_are_told(tmp_path, times, told):
    np.savez(tmp_path / "a.npz", depth=np.ones((2, 4, 4)), times=np.array(times))
    with pytest.raises(ObservationError, match=told) as error:
        read_depth(tmp_path / "a.npz")
    assert error.value.file == tmp_path / "a.npz" and "seconds" in error.value.remedy


@pytest.mark.parametrize("runs", [np.ones((48, 1)), np.ones((1, 48)), np.float64(48)])
def test_runs_of_masks_of_another_shape_are_told(runs):
    with pytest.raises(ObservationError, match="starts of masks .* and runs"):
        Detections("a", 30.0, (8, 6), np.zeros((1, 1, 33, 2)), np.zeros((1, 1, 33)), runs, np.array([0, 48]), "a.npz")


NUMBERS = [name for name, array in body_to_arrays(load_body("humanoid_morphing")).items() if array.dtype.kind == "f"]


@pytest.mark.parametrize("name", [name for name in NUMBERS if not name.startswith("surfaces/")])
def test_a_body_with_a_number_that_is_none_is_told(tmp_path, name):
    arrays = body_to_arrays(load_body("humanoid_morphing"))
    arrays[name] = np.array(arrays[name])
    arrays[name].flat[arrays[name].size // 2] = np.nan
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(BodyError) as error:
        load_body(tmp_path / "a.npz")
    assert error.value.file == tmp_path / "a.npz" and error.value.remedy


def test_a_reference_pose_that_is_not_finite_is_told_by_its_coordinate(tmp_path):
    arrays = body_to_arrays(load_body("arm"))
    for value in (np.nan, np.inf):
        arrays["usual"] = np.where(np.arange(len(arrays["usual"])) == 2, value, arrays["usual"])
        np.savez(tmp_path / "a.npz", **arrays)
        with pytest.raises(BodyError, match="not finite") as error:
            load_body(tmp_path / "a.npz")
        assert error.value.place == f"usual of {arrays['coordinates'][2]}"


def segments(count):
    head = '[body]\nname = "a"\n[[segment]]\nname = "s0"\njoint = { name = "j0", type = "free" }\n'
    return head + "".join(
        f'[[segment]]\nname = "s{k}"\nparent = "s0"\njoint = {{ name = "j{k}", type = "fixed" }}\n'
        for k in range(1, count)
    )


def test_a_body_of_more_segments_than_any_is_told(tmp_path):
    (tmp_path / "a.toml").write_text(segments(1001))
    with pytest.raises(BodyError, match="1001 segments, couplings, closures or dimensions, more than 1000"):
        load_body(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text(segments(1000))
    assert len(load_body(tmp_path / "a.toml").tree.segments) == 1000


class Counted(str):
    """A name that counts how often it is compared."""

    comparisons = 0

    def __eq__(self, other):
        Counted.comparisons += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_repeated_names_are_found_by_a_comparison_for_each():
    names = [Counted(k) for k in range(2000)]
    Counted.comparisons = 0
    assert repeated([*names, Counted(7), Counted(3)]) == ["3", "7"]
    assert Counted.comparisons < 2 * len(names)
    Counted.comparisons = 0
    clicks = Clicks(0, {camera: {Counted(k): (1.0, 2.0) for k in range(2000)} for camera in "ab"})
    assert len(clicks.names) == 2000 and Counted.comparisons < 8 * 2000


@pytest.mark.parametrize(
    ("text", "told"),
    [("[" * 100_000, "is not JSON"), ('{"points": {"a": {"b": [1, %s]}}}' % ("9" * 400), "not a pixel"),
     ('{"points": {"a": {"b": [NaN, 1]}}}', "not a pixel"),
     ('{"step": %s, "points": {}}' % ("9" * 400), "not a frame number"),
     ("[]", "holds no points"), ('[{"points": {}}, {"points": {}}]', "step 0 appears twice"),
     ("\xff", "is not JSON")],
)  # fmt: skip
def test_clicks_that_are_none_are_told(tmp_path, text, told):
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    with pytest.raises(FileError, match=told) as error:
        read_clicks(tmp_path / "a.json")
    assert error.value.file == tmp_path / "a.json"


def test_a_device_without_an_end_is_not_read():
    if not Path("/dev/zero").exists():
        pytest.skip("no such device")
    with pytest.raises(FileError, match="not a file"):
        read_bytes(Path("/dev/zero"))


def gltf(tmp_path, binary=b"", **more):
    path = tmp_path / "a.glb"
    path.write_bytes(packed_glb({"asset": {"version": "2.0"}, "nodes": [{}]} | more, binary))
    return path


def test_nodes_are_ordered_in_one_pass(monkeypatch):
    monkeypatch.setattr(np, "flatnonzero", lambda *_: pytest.fail("a search among all nodes for each of them"))
    parents = np.array([1, -1, 1, 0, 3])
    assert _order(parents).tolist() == [1, 0, 2, 3, 4]


def test_more_nodes_than_any_character_has_are_told(tmp_path):
    with pytest.raises(FileError, match="more than 20000 nodes"):
        read_character(gltf(tmp_path, nodes=[{}] * 20_001))


MESH = {
    "nodes": [{"mesh": 0, "skin": 0}], "skins": [{"joints": [0]}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}}]}],
}  # fmt: skip


def mesh(count, **view):
    accessors = [{"bufferView": 0, "componentType": kind, "type": width, "count": count}
                 for kind, width in ((5126, "VEC3"), (5121, "VEC4"), (5126, "VEC4"))]  # fmt: skip
    buffer = {"buffer": 0, "byteLength": 64, **view}
    return MESH | {"buffers": [{"byteLength": 64}], "bufferViews": [buffer], "accessors": accessors}


def test_vertices_that_lie_on_each_other_are_no_billions(tmp_path):
    with pytest.raises(FileError, match="byteStride 0"):
        read_character(gltf(tmp_path, bytes(64), **mesh(10**9, byteStride=0)))


def test_a_mesh_that_many_nodes_show_is_no_larger_than_any_character(tmp_path, monkeypatch):
    monkeypatch.setattr("kinefit.readers.skeletons.characters._MAX_VERTICES", 10)
    told = mesh(4)
    assert len(read_character(gltf(tmp_path, bytes(64), **told)).points) == 4
    with pytest.raises(FileError, match="more than 10 vertices"):
        read_character(gltf(tmp_path, bytes(64), **(told | {"nodes": told["nodes"] * 3})))


def test_buffers_and_images_that_are_named_often_are_taken_in_once(tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(1000))
    buffers = [{"byteLength": 1000, "uri": "a.bin"}] * 50
    images = [{"uri": "a.bin"} for _ in buffers]
    tree = {"asset": {"version": "2.0"}, "nodes": [{}], "buffers": buffers, "images": images}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert len(read_gltf(tmp_path / "a.gltf").binary) == 1000
    with pytest.raises(FileError, match="without a URI that is not the first"):
        read_gltf(gltf(tmp_path, bytes(1000), buffers=[{"byteLength": 1000}] * 50))


@pytest.mark.parametrize("uri", ["/etc/hostname", "../outside.bin", "%2e%2e/outside.bin", "file:///etc/hostname"])
def test_a_character_carries_off_no_file_from_outside_of_its_folder(tmp_path, uri):
    (tmp_path / "outside.bin").write_bytes(b"mine")
    folder = tmp_path / "theirs"
    folder.mkdir()
    tree = {"asset": {"version": "2.0"}, "nodes": [{}], "images": [{"uri": uri}]}
    (folder / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(FileError, match=r"outside of its folder|no such file|cannot be read"):
        read_gltf(folder / "a.gltf")


@pytest.mark.parametrize(
    ("more", "told"),
    [({"nodes": {}}, "nodes is no list"), ({"animations": 3}, "animations is no list"),
     ({"nodes": [{"name": 3}]}, "name is 3"), ({"nodes": [{"translation": [0, 0, 1e999]}]}, "not finite")],
)  # fmt: skip
def test_gltf_that_is_none_is_told(tmp_path, more, told):
    with pytest.raises(FileError, match=told):
        read_character(gltf(tmp_path, **more))


def test_a_glb_whose_lengths_lie_is_told(tmp_path):
    path = gltf(tmp_path)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 8, 2**31)
    path.write_bytes(data)
    with pytest.raises(FileError, match="no whole glTF"):
        read_character(path)
