"""Every TOML block of the pages is read by what reads such files: takes, bodies, marker sets, points in images."""

import re
import tomllib

import pytest
from click.testing import CliRunner
from tests.docs.blocks import blocks, pages

from kinefit.bodies import load_body
from kinefit.bodies.marker_sets import placement
from kinefit.cli import main
from kinefit.readers.landmarks.annotations import read_static_points
from kinefit.readers.landmarks.networks import read_description
from kinefit.readers.take.entries import TABLES
from kinefit.readers.take.file import read_take
from kinefit.readers.take.kinds import BUILT_IN

CAMERA = '[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam01"\nvideo = "cam01.mp4"\n'
SENSOR = '[[keypoints]]\ncamera = "cam01"\nfile = "cam01.npy"\nformat = "mediapipe"\n'
SEGMENT = '[body]\nname = "limb"\n[[segment]]\nname = "limb"\njoint = { name = "free", type = "free" }\n'
BOX = "".join(
    [f"v {x} {y} {z}\n" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)]
    + [f"f {a} {b} {c}\n" for a, b, c in ((1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2), (3, 4, 8),
                                         (3, 8, 7), (1, 3, 7), (1, 7, 5), (2, 6, 8), (2, 8, 4))]
)  # fmt: skip


def whole(text):
    """What a block is, as the whole file that it belongs into: (kind, text)."""
    keys = tomllib.loads(text).keys()
    tables = {*TABLES, *BUILT_IN}
    if keys <= tables:
        if not keys & {"camera", "depth"}:
            text += CAMERA
        if not keys & (tables - {"take", "session", "start", "calibration", "camera"}) and "stream" not in text:
            text += SENSOR
        return "take", text
    if "project" in keys:
        return "package", text
    if keys & {"body", "segment"}:
        return "body", text
    if keys == {"surface"}:
        return "body", SEGMENT + text
    if keys <= {"coupling", "dimension", "morph"}:
        base = "snowboarder" if "dimension" in keys else "humanoid"
        return "body", f'[body]\nname = "changed"\nbase = "{base}"\n{text}'
    if "mapping" in keys:
        return "network", text
    if keys == {"skin"}:
        return "body", SEGMENT + text
    return ("marker set" if "markers" in keys else "points"), text


def read(kind, text, folder):
    """What reads a file of that kind makes of it, beside empty files of the names in it."""
    for name in re.findall(r'(?:file|video|norms|model|clicks) = "(.+?)"', text):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    for name in re.findall(r'mesh = "(.+?)"', text):
        (folder / name).write_text(BOX)
    for name in re.findall(r'contour = "(.+?)"', text):
        (folder / name).write_text("0.1,0.0,0.0\n0.0,0.1,0.0\n-0.1,0.0,0.0\n0.0,-0.1,0.0\n")
    for name in re.findall(r'weights = "(.+?)"', text):
        (folder / name).write_text("".join(f"{k + 1}, limb, 1\n" for k in range(8)))
    if 'body = "snowboarder.toml"' in text:  # as `kinefit body copy` leaves it
        CliRunner().invoke(main, ["body", "copy", "snowboarder", str(folder / "snowboarder.toml")])
    content = tomllib.loads(text)
    path = folder / f"{content['body']['name'] if kind == 'body' else kind}.toml"
    path.write_text(text, encoding="utf-8")
    if kind == "package":  # which tests/test_plugins.py installs
        return content["project"]
    if kind == "take":
        take = read_take(path)
        return take if "body" not in content.get("take", {}) else load_body(take.body)
    if kind == "body":
        return load_body(path)
    if kind == "network":
        return read_description(path.with_suffix(".onnx"))
    if kind == "marker set":
        return placement(load_body("humanoid"), path)
    return read_static_points(path, ("cam01", "cam03"))


@pytest.mark.parametrize("page", pages("toml"))
def test_a_block_is_read_by_what_reads_such_files(page, tmp_path):
    for block in blocks(page, "toml"):
        kind, text = whole(block.text)
        assert read(kind, text, tmp_path), f"{page}.md:{block.line}"


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ('[[depth]]\nname = "a"\nfile = "a.npz"\nrnage = [0, 1]\n', "rnage"),
        ('[[lines]]\ncamera = "cam02"\nfile = "a.csv"\nlandmarks = { a = ["r_wrist"] }\n', "cam02"),
        ("surface = { balls = [{ at = [0, 0, 0], radi = [1, 1, 1] }] }\n", "radi"),
    ],
)
def test_a_wrong_key_or_name_is_found(wrong, told, tmp_path):
    with pytest.raises(Exception, match=told):
        read(*whole(wrong), tmp_path)
