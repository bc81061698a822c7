"""Every reader on damaged files: a typed error or a result, soon and in little memory; and what was found so."""

import json
import os
import re
import subprocess
import sys
import time
import zlib
from pathlib import Path

import av
import numpy as np
import pytest
from benchmarks.robustness.fuzz.fuzz import SLOW, fuzz
from benchmarks.robustness.fuzz.fuzz_mutations import mutated
from benchmarks.robustness.fuzz.fuzz_readers import READERS, seed_of
from benchmarks.robustness.fuzz.fuzz_seeds import ASF
from benchmarks.robustness.fuzz.fuzz_worker import LONGEST

from kinefit._files import parse_toml
from kinefit.bodies import load_body
from kinefit.bodies.surfaces import Metaballs
from kinefit.cli.surfaces._measure import read_seeds
from kinefit.errors import BodyError, CalibrationError, FileError, KinefitError, ObservationError
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.depth.clouds import FileCloud, camera_of, read_cloud
from kinefit.readers.depth.images import listed
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.guess.names import camera_number, natural
from kinefit.readers.landmarks.annotations import read_static_points
from kinefit.readers.landmarks.keypoints import read_caliscope_csv, read_keypoints
from kinefit.readers.skeletons.acclaim import read_asf
from kinefit.readers.take.file import read_take
from kinefit.readers.videos.video import Video
from kinefit.sensors.kinds.surface_points import read_surface_points

COPIES = 25  # of each reader here; `python -m benchmarks product fuzz` reads thousands
linux = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is counted as Linux does")


@pytest.mark.parametrize("name", READERS)
@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_answered(name, tmp_path):
    seed = seed_of(name, tmp_path)
    seed.read()
    whole = [file.read_bytes() for file in seed.files]
    for i in range(COPIES):
        which, began = i % len(whole), time.process_time()
        seed.files[which].write_bytes(mutated(whole[which], [zlib.crc32(name.encode()), i]))
        try:
            seed.read()
        except KinefitError as error:
            assert len(str(error).replace(str(tmp_path), "")) <= LONGEST
        assert time.process_time() - began < SLOW
        seed.files[which].write_bytes(whole[which])


@linux
def test_files_are_counted_in_a_process_of_their_own(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    found = fuzz("lines csv", 40)
    assert found.total() == 40 and set(found) == {"read", "typed"}


def test_damage_is_the_same_in_every_run():
    data = b"frame,line\n0,1.5\n1,2.5\n" * 20
    assert [mutated(data, [1, i]) for i in range(20)] == [mutated(data, [1, i]) for i in range(20)]
    assert len({mutated(data, [1, i]) for i in range(50)}) > 40


@linux
def test_a_reader_that_fails_is_counted(tmp_path):
    code = (
        "import os, numpy as np\n"
        "from benchmarks.robustness.fuzz import fuzz_readers as r, fuzz_seeds as s, fuzz_worker as w\n"
        "def make(folder):\n"
        "    (folder / 'a').write_bytes(b'1')\n"
        "    whole = [True]\n"
        "    def read():\n"
        "        if whole: return whole.pop()\n"
        "        if KIND == 'untyped': raise ValueError('x')\n"
        "        if KIND == 'memory': return np.ones(10**9)\n"
        "        os.abort()\n"
        "    return s.Seed((folder / 'a',), read)\n"
        "r.READERS['x'] = make; w.main('x', 0, 1, 500)\n"
    )
    for kind in ("untyped", "memory", "abort"):
        words = [sys.executable, "-c", code.replace("KIND", repr(kind))]
        done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[2], env=os.environ)
        assert "at 0" in done.stdout
        assert (f"0 {kind}" in done.stdout) == (kind != "abort") and (done.returncode != 0) == (kind == "abort")


def caliscope(path, *rows):
    path.write_text("sync_index,port,frame_time,point_id,img_loc_x,img_loc_y\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(
    ("row", "told"),
    [("1e11,0,0.1,3,5,6", "sync_index = 1e+11"), ("3,0,0.1,-1,5,6", "point_id = -1"),
     ("3,0,0.1,2.5,5,6", "point_id = 2.5"),
     ("90000000,0,0.1,3,5,6", "2 frames in 90000001 of sync_index"), ("0,-2,0.1,3,5,6", "port = -2")],
)  # fmt: skip
def test_indices_of_a_table_that_cannot_be_are_told(tmp_path, row, told):
    with pytest.raises(ObservationError, match=told.replace("+", r"\+")):
        read_caliscope_csv(caliscope(tmp_path / "xy.csv", "0,0,0.0,3,5,6", row))


def test_limits_of_a_bone_that_are_no_numbers_are_told(tmp_path):
    for limits in ("(-90 x)", "(-90 nan)"):
        (tmp_path / "a.asf").write_text(ASF.replace("(-90 90)", limits))
        with pytest.raises(FileError, match="limits that are no numbers"):
            read_asf(tmp_path / "a.asf")
    (tmp_path / "a.asf").write_text(ASF.replace("     id 2\n", "     (0 1)\n"))
    assert len(read_asf(tmp_path / "a.asf").bones) == 3  # no limits of the bone before


def test_a_matrix_of_rows_without_end_is_told(tmp_path):
    matrix = '{"type_id": "opencv-matrix", "rows": 100000000000000000000, "cols": 3, "dt": "d", "data": [1.0]}'
    (tmp_path / "a.json").write_text(f'{{"cam": {{"camera_matrix": {matrix}}}}}')
    with pytest.raises(CalibrationError, match="not a readable JSON"):
        read_calibration(tmp_path / "a.json")


@pytest.mark.parametrize("opened", ["{", "[", "- ", "{a: "])
def test_tables_within_tables_do_not_end_the_process(tmp_path, opened):
    (tmp_path / "a.yml").write_text(f"%YAML:1.0\n---\na:\n  {opened * 50_000}\n")
    with pytest.raises(CalibrationError, match="line 4: (nested too deeply|exceeded maximum|the key)"):
        read_calibration(tmp_path / "a.yml")


def test_a_cloud_of_sizes_that_there_are_not_is_told(tmp_path):
    head = "VERSION .7\nFIELDS x y z\nSIZE {} 4 4\nTYPE F F F\nCOUNT {} 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
    for size, count in ((0, 1), (-4, 1), (4, 0), (4, -1), (3, 1)):
        (tmp_path / "a.pcd").write_bytes(head.format(size, count).encode() + bytes(64))
        with pytest.raises(FileError, match="SIZE"):
            read_cloud(tmp_path / "a.pcd")


def test_a_pixel_of_five_hundred_digits_is_told(tmp_path):
    (tmp_path / "points.toml").write_text(f"[beam]\na = [1, 2]\nb = [3, {'9' * 500}]\n")
    with pytest.raises(ObservationError, match="not a pixel") as error:
        read_static_points(tmp_path / "points.toml", ("a", "b"))
    assert len(str(error.value)) < 600


def test_a_video_of_a_codec_that_nobody_knows_is_told(tmp_path):
    path = tmp_path / "a.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes().replace(b"FMP4", b"zzzz"))
    with pytest.raises(FileError, match="codec"):
        Video(path)


def test_packed_points_that_claim_gigabytes_are_told(tmp_path):
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\n"
    head += "DATA binary_compressed\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + np.array([4, 2**33 - 2**32 - 1], "<u4").tobytes() + bytes(4))
    with pytest.raises(FileError):
        read_cloud(tmp_path / "a.pcd")


def test_points_at_the_end_of_the_world_are_told(tmp_path):
    points = np.random.default_rng(0).random((400, 3)) + 0.1
    points[:, 0] *= 1e300
    cloud = FileCloud(points, (20, 20), np.eye(4))
    with pytest.raises(CalibrationError, match="no camera sees"):
        camera_of(cloud, "a")


@pytest.mark.parametrize("base", ["humanoid" + "(" * 5000, "../../x", "a\\u0000.toml", "b" * 5000 + ".toml"])
def test_a_base_that_cannot_be_a_file_is_told(tmp_path, base):
    (tmp_path / "body.toml").write_text(f'[body]\nname = "thing"\nbase = "{base}"\n')
    with pytest.raises(BodyError) as error:
        load_body(tmp_path / "body.toml")
    assert error.value.place == "body.base" and len(str(error.value)) < LONGEST + 60


@pytest.mark.parametrize("mesh", ["a\\u0000.obj", "[" * 5000, "a/" * 3000 + "a.obj"])
def test_a_mesh_that_cannot_be_a_file_is_told(tmp_path, mesh):
    seed = seed_of("body mesh", tmp_path)
    body = tmp_path / "body.toml"
    body.write_text(body.read_text().replace("a.obj", mesh))
    with pytest.raises(BodyError, match="cannot read the mesh") as error:
        seed.read()
    assert len(str(error.value).replace(str(tmp_path), "")) <= LONGEST


@pytest.mark.parametrize("ball", ["radii = [1e-320, 0.06, 0.05]", "at = [0, 0, 1e308]", "radii = [0.1, 1e300, 1]"])
def test_metaballs_of_no_size_are_told(tmp_path, ball):
    key = ball.split()[0]
    seed = seed_of("metaballs toml", tmp_path)
    text = (tmp_path / "body.toml").read_text()
    (tmp_path / "body.toml").write_text(re.sub(rf"{key} = \[[^\]]*\](?=[^\n]*\}},\n)", ball, text, count=1))
    with pytest.raises(BodyError, match="ball 1 at"):
        seed.read()


def test_a_thin_ball_beside_thick_ones_is_drawn():
    balls = Metaballs.of(0, [[0, 0, 0], [0, 0.002, 0], [0, 0.6, 0]], [[2e-4] * 3, [0.002] * 3, [1.0] * 3])
    assert np.isfinite(balls.vertices).all()


@pytest.mark.parametrize(
    ("text", "told"),
    [("1,2,3,4\n1,2,3\n", "line 2: 3 columns, not 4"), ("u,v,u,v\n\n1,2,x,4\n", "line 3: 'x' is no number"),
     ("1,2,3,4\0\n", "no number"), ("u,v,u,v\n", "no points"), ('1,2,3,"' + "4" * 140_000, "field larger")],
)  # fmt: skip
def test_a_table_of_seeds_that_is_none_is_told(tmp_path, text, told):
    (tmp_path / "seeds.csv").write_text(text)
    with pytest.raises(FileError, match=told):
        read_seeds(tmp_path / "seeds.csv", 2)


def test_a_file_that_still_can_be_read_is_damaged_within():
    toml = b'[take]\nrate = 30.0\nname = "a"\n[[camera]]\nname = "b"\nsize = [64, 48]\n'
    tree = b'{"version": 1.3, "people": [{"points": [1, 2, 3]}]}'
    for data, parse in ((toml, lambda text: parse_toml(text.decode(), "a")), (tree, json.loads)):
        read = 0
        for i in range(100):
            damaged = mutated(data, [2, i])
            try:
                read += parse(damaged) != parse(data)
            except (KinefitError, ValueError):
                continue
        assert read > 20


def test_times_of_a_surface_that_cannot_be_are_told(tmp_path):
    head = "time_s,point,x,y,z,std_x,std_y,std_z\n"
    odd = (((0, 1e-320), "apart"), ((0, 1e20), "apart"), ((1e308, 2e307), "apart"), ((1e12, 1e12 + 1), "from 1e"))
    for times, told in odd:
        rows = "".join(f"{time!r},1,0,0,1,0.1,0.1,0.1\n" for time in times)
        (tmp_path / "a.csv").write_text(head + rows)
        with pytest.raises(ObservationError, match=told):
            read_surface_points(tmp_path / "a.csv")


def test_a_camera_of_five_thousand_digits_has_a_number():
    assert camera_number("cam" + "0" * 5000 + "12") == 12
    assert natural("1\u00b22.png") > natural("1a.png")


def test_a_video_that_claims_more_than_there_is_memory_for_is_told(tmp_path):
    seed = seed_of("video mp4", tmp_path)
    data = bytearray(seed.files[0].read_bytes())
    at = data.index(b"stsz") + 12
    data[at : at + 4] = bytes([0xFF, 0xFF, 0xFF, 0x0F])
    seed.files[0].write_bytes(data)
    with pytest.raises(FileError):
        seed.read()


@pytest.mark.parametrize(("name", "told"), [("a**.png", "no such file"), ("a/" * 3000, "too long"), ("[*", "no such")])
def test_a_pattern_that_cannot_be_is_told(tmp_path, name, told):
    entry = f'[[depth]]\nname = "d"\nfile = "{name}"\nintrinsics = [60.0, 60.0, 32.0, 24.0]\n'
    (tmp_path / "take.toml").write_text(f"[take]\nrate = 30.0\n{entry}")
    with pytest.raises(KinefitError, match=told):
        read_take(tmp_path / "take.toml")


def test_two_stars_are_one(tmp_path):
    (tmp_path / "a1.png").touch()
    assert listed(tmp_path / "a**.png") == [tmp_path / "a1.png"]


@pytest.mark.parametrize("stature", ["nan", "inf", "-1.0"])
def test_a_stature_that_is_none_is_told(tmp_path, stature):
    (tmp_path / "a.toml").write_text(f'[body]\nname = "a"\nbase = "arm"\nstature = {stature}\n')
    with pytest.raises(BodyError, match="a stature of"):
        load_body(tmp_path / "a.toml")


def test_a_morph_of_a_segment_without_a_name_is_told(tmp_path):
    seed = seed_of("body toml", tmp_path)
    body = tmp_path / "body.toml"
    kind = re.search(r'kind = "joint"\n(?:[^\n\[]*\n)*?segment = "(\w+)"', body.read_text())
    body.write_text(body.read_text().replace(kind[0], kind[0].replace(kind[1], "")))
    with pytest.raises(BodyError, match="no segment ''"):
        seed.read()


def test_a_camera_of_five_thousand_digits_is_none_of_a_table(tmp_path):
    path = caliscope(tmp_path / "xy.csv", "0,0,0.0,3,5,6", "1,0,0.1,3,5,6")
    with pytest.raises(ObservationError, match="no camera in this file") as error:
        read_keypoints(path, format="caliscope", camera="cam" + "9" * 5000, rate=10.0)
    assert len(str(error.value).replace(str(tmp_path), "")) <= LONGEST


def test_a_table_that_a_spreadsheet_wrote_is_read(tmp_path):
    path = caliscope(tmp_path / "xy.csv", "0,0,0.0,3,5,6", "1,0,0.1,3,5,6")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert set(read_caliscope_csv(path)) == {"cam_0"}
    seed = seed_of("body skin", tmp_path)
    (tmp_path / "skin.csv").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "skin.csv").read_bytes())
    assert seed.read().skin is not None


@pytest.mark.parametrize("name", ["caliscope", "surface points", "bar"])
def test_columns_that_semicolons_separate_are_told(tmp_path, name):
    seed = seed_of(name, tmp_path)
    seed.files[0].write_text(seed.files[0].read_text().replace(",", ";"))
    with pytest.raises(KinefitError, match="separated by ';', not by commas"):
        seed.read()


def test_a_folder_of_photographs_is_no_depth(tmp_path):
    (tmp_path / "0001.jpg").write_bytes(bytes(100))
    with pytest.raises(FileError, match=r"\.jpg files hold colour"):
        read_depth(tmp_path, rate=30.0)
