"""The user's pages name every key, default, format and exit code, and none that does not exist."""

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from kinefit.bodies import catalogue, load_body
from kinefit.bodies.toml import records
from kinefit.bodies.toml.bodies import JOINT_TYPES
from kinefit.exporters import tables
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.take import entries
from kinefit.readers.take import file as takes
from kinefit.sensors.kinds.silhouettes import SilhouetteEntry
from kinefit.simulation import cut, squat_and_wave
from kinefit.takes.batch.results import FORMATS

DOCS = Path(__file__).resolve().parents[2] / "docs"
TAKE, BODIES, FILES = ((DOCS / f"{name}.md").read_text(encoding="utf-8") for name in ("take-file", "bodies", "files"))


def section(page, heading):
    start = page.index(f"{heading}\n")
    level = heading.split(" ")[0]
    following = re.search(rf"^#{{2,{len(level)}}} ", page[start + len(heading) :], re.M)
    return page[start : start + len(heading) + following.start()] if following else page[start:]


def rows(text):
    """First cell's names -> all cells, of the tables in a text."""
    found = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `"):
            found |= dict.fromkeys(re.findall(r"`([^`]+)`", cells[0]), cells)
    return found


@pytest.mark.parametrize(
    ("page", "heading", "record"),
    [
        (TAKE, "## `[take]`", entries.TakeHead), (TAKE, "## `[start]`", entries.StartEntry),
        (TAKE, "## `[calibration]`", entries.CalibrationEntry),
        (TAKE, "## `[[camera]]`", entries.CameraEntry), (TAKE, "## `[[keypoints]]`", entries.KeypointsEntry),
        (TAKE, "## `[[markers]]`", entries.MarkersEntry), (TAKE, "## `[[depth]]`", entries.DepthEntry),
        (TAKE, "## `[[stereo]]`", entries.StereoEntry), (TAKE, "## `[[silhouette]]`", SilhouetteEntry),
        (BODIES, "## `[body]`", records.HeadRecord),
        (BODIES, "## `[[segment]]`", records.SegmentRecord), (BODIES, "### `joint`", records.JointRecord),
    ],
)  # fmt: skip
def test_every_key_is_there_with_its_default(page, heading, record):
    told = rows(section(page, heading).removeprefix("### ").split("### ")[0].split("| type |")[0])
    fields = {field.name: field for field in msgspec.inspect.type_info(record).fields}
    assert set(told) == set(fields)
    for name, field in fields.items():
        default = field.default
        if isinstance(default, str | float | int) and not isinstance(default, bool) and default != "":
            text = f'"{default}"' if isinstance(default, str) else str(default)
            assert f"`{text}`" in told[name], f"{heading} {name}: default {text}"
        if field.required:
            assert not any(cell.startswith("`") for cell in told[name][1:-1]), f"{heading} {name} has no default"


def test_the_sample_take_of_the_page_is_read(tmp_path):
    text = re.search(r"```toml\n(.*?)```", TAKE, re.S)[1]
    for name in re.findall(r'(?:file|video) = "(.+?)"', text):
        (tmp_path / name).touch()
    (tmp_path / "take.toml").write_text(text)
    take = takes.read_take(tmp_path / "take.toml")
    assert [camera.name for camera in take.cameras] == ["cam01", "cam03"]
    assert tomllib.loads(text)["take"].keys() <= set(rows(section(TAKE, "## `[take]`")))


def test_bodies_joints_and_keypoint_sets_are_those_that_exist():
    told = rows(BODIES.split("## Conventions")[0])
    assert set(told) == set(catalogue())
    for name, cells in told.items():
        tree = load_body(name).tree
        counts = [str(len(tree.segments)), str(len(tree.coordinates))]
        assert cells[1:4] == [*counts, "free" if tree.root_free else "fixed"]
    joints = rows(section(BODIES, "### `joint`").partition("| type |")[2])
    assert {name: int(cells[1]) for name, cells in joints.items()} == JOINT_TYPES
    for name in KEYPOINT_SETS:
        assert f"`{name}`" in TAKE
        assert f"`{name}`" in section(BODIES, "## `[keypoints.SET]`")
    tree = load_body("humanoid").tree
    named = re.search(r"Rajagopal 2015 model.*?\n- ", BODIES, re.S)[0]
    assert set(re.findall(r"`(\w+)`", named)) <= set(tree.coordinates)


def test_all_formats_and_tables_are_told():
    told = " ".join(cells[1] for cells in rows(FILES.split("## The motion file")[0]).values())
    assert set(re.findall(r"`(\w+)`", told)) == set(FORMATS.built_in)
    motion = cut(squat_and_wave(), 0, 2)
    assert set(rows(section(FILES, "## Tables"))) == set(tables(motion))


def test_exit_codes_are_those_of_the_help():
    from kinefit.cli import main

    told = re.findall(r"^\| (\d+) \|", section(FILES, "## Exit codes"), re.M)
    assert told == re.findall(r"^  (\d+) ", main.epilog, re.M)
