"""What a depth camera's images say of its unit, lens and kind of distance, and what a check leaves open."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.rigs.diagnostics.person import depth_findings, moving_extent

FOCAL = 144.0
V, U = np.indices((120, 160))
X, Y = (U - 79.5) / FOCAL, (V - 59.5) / FOCAL


def scene(frames=8, *, radial=False):
    """(F, H, W) [m]: a thing of a person's size walks before a wall, over a floor."""
    wall = np.minimum(4.0, np.where(Y > 0, 1.2 / np.maximum(Y, 1e-6), 9.0))
    inside = [(np.abs(2.6 * X + 0.8 - 1.6 * k / frames) < 0.25) & (np.abs(2.6 * Y - 0.3) < 0.85) for k in range(frames)]
    return np.stack([np.where(i, 2.6, wall) for i in inside]) * (np.sqrt(1 + X**2 + Y**2) if radial else 1.0)


def take(folder, counts, *, centre=79.5, keys=""):
    (folder / "depth").mkdir()
    for i, image in enumerate(np.rint(counts).astype(np.uint16)):
        cv2.imwrite(str(folder / "depth" / f"{i:03d}.png"), image)
    lens = f"intrinsics = [{FOCAL}, {FOCAL}, {centre}, 59.5]"
    text = f'[take]\nup = "-y"\nrate = 30.0\n[[depth]]\nname = "k"\nfile = "depth"\n{lens}\n{keys}\n'
    (folder / "take.toml").write_text(text)
    read = read_take(folder / "take.toml")
    return read, load_observations(read).depth


@pytest.mark.parametrize(("counts", "how", "kinds"), [
    (1000 * scene(), {}, []),
    (5000 * scene(), {}, ["unit"]),
    (5000 * scene(), {"keys": "unit = 0.0002"}, []),
    (2000 * scene(), {}, ["unit"]),
    (1000 * scene(radial=True), {}, ["radial"]),
    (1000 * np.where(scene() < 3.0, scene(radial=True), 0.0) * (Y < 0.35), {}, []),  # a person alone is no wall
    (1000 * scene(), {"centre": 112.0}, ["intrinsics"]),
])  # fmt: skip
def test_units_lenses_and_rays(tmp_path, counts, how, kinds):
    findings = depth_findings(*take(tmp_path, counts, **how))
    assert [finding.kind for finding in findings] == kinds
    for finding in findings:
        assert finding.severity == "doubt" and finding.remedy and "A guess." in str(finding)


def test_the_unit_that_would_fit_a_person_is_named(tmp_path):
    (finding,) = depth_findings(*take(tmp_path, 5000 * scene()))
    assert "8.13 m large" in finding.text and "about 0.0002" in finding.remedy


def test_where_nothing_moves_there_is_no_extent(tmp_path):
    _, (video,) = take(tmp_path, 1000 * np.repeat(scene(1), 4, axis=0))
    assert moving_extent(video, [video.frame(i).depth for i in range(4)]) is None


def test_check_says_what_it_cannot_see_of_depth_alone(tmp_path):
    take(tmp_path, 5000 * scene())
    told = " ".join(CliRunner().invoke(main, ["check", str(tmp_path / "take.toml")]).output.split())
    assert "not checked are the poses" in told and "mirrored" in told and "about 0.0002 would fit" in told
