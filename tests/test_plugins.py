"""Sensors of another distribution: installed as pip does, found in a fresh process; what goes wrong names the plug-in."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import ROOT
from tests.docs.blocks import blocks

from kinefit.readers.motion import read_motion
from kinefit.simulation import squat_and_wave

MODULE = next(block.text for block in blocks("own-sensor", "python") if "KIND = SensorKind" in block.text)
PROJECT = next(block.text for block in blocks("own-sensor", "toml") if "[project]" in block.text)
NAMED = r"the plug-in kinefit-insole 0\.1 \(entry point 'insole' of kinefit\.sensors\)"


@dataclass
class Site:
    """A folder of installed distributions beside those of the tests."""

    folder: Path

    def install(self, module=MODULE, project=PROJECT):
        """Install the plug-in as its author would, without a network; its folder is not on the path afterwards."""
        source = self.folder.parent / f"source-{len(list(self.folder.parent.iterdir()))}"
        source.mkdir()
        name = re.search(r'^name = "(.+)"', project, re.M)[1].replace("-", "_")
        (source / f"{name}.py").write_text(module)
        (source / "pyproject.toml").write_text(project)
        options = ("--no-build-isolation", "--no-deps", "--no-index", "--quiet", "--upgrade")
        pip = [sys.executable, "-m", "pip", "install", *options, "--target", self.folder, source]
        subprocess.run(pip, check=True, capture_output=True, text=True)

    def change(self, *pairs):
        """Change the code of the installed plug-in."""
        text = MODULE
        for old, new in pairs:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (self.folder / "kinefit_insole.py").write_text(text)

    def kinefit(self, *words):
        """Run a command in a fresh process that sees the folder; returns its exit code and all that it printed."""
        path = os.pathsep.join([str(self.folder), str(ROOT / "src")])
        environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "1000", "NO_COLOR": "1"}
        command = [sys.executable, "-P", "-m", "kinefit", *map(str, words)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    site = Site(tmp_path_factory.mktemp("site") / "packages")
    site.install()
    return site


@pytest.fixture
def plugin(installed):
    installed.change()
    yield installed
    installed.change()


@pytest.fixture
def recording(tmp_path, copy_take):
    """A folder of videos, keypoints and an insole: a simulated person who stands on both feet."""
    take = copy_take(tmp_path / "recording")
    rows = [f"{t:.6f},300,120" for t in squat_and_wave().times]
    (take.parent / "insole_right.csv").write_text("\n".join(["time_s,heel,toe", *rows]) + "\n")
    take.write_text(take.read_text() + '\n[[insole]]\nfile = "insole_right.csv"\nfoot = "right"\n')
    return take


def test_a_sensor_of_another_distribution_goes_from_init_to_the_report(plugin, recording, tmp_path):
    recording.unlink()
    code, said = plugin.kinefit("init", recording.parent)
    assert code == 0 and "pressure under the right foot" in said
    text = recording.read_text()
    assert re.search(r"^\[\[insole\]\] +# of the plug-in kinefit-insole 0\.1$", text, re.M)
    assert re.search(r'^file = "insole_right.csv" +# likely: pressure', text, re.M) and 'foot = "right"' in text
    recording.write_text(text + "least = 1e4\n")
    code, said = plugin.kinefit("check", recording)
    assert code == 0 and "insole_right.csv: no cell is ever loaded with 10000 N" in said
    recording.write_text(text)
    out = tmp_path / "out"
    code, said = plugin.kinefit("track", recording, "-o", out, "--no-overlays")
    assert code == 0, said
    motion = read_motion(out / "motion.npz")
    assert "insole" in motion.residuals and "insole" in motion.provenance["sensor noise"]
    body = motion.body
    heel = [body.positions(motion.state(i), body.landmarks.select(("r_heel",)))[0, 2] for i in range(len(motion))]
    assert np.sqrt(np.mean(np.square(heel))) < 0.004
    assert "insole" in (out / "report.html").read_text("utf-8")
