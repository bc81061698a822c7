"""Sensors of another distribution, installed by pip and found in a fresh process; errors name the plug-in."""

import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import ROOT
from tests.docs.blocks import blocks

from kinefit.errors import FileError, ObservationError, PluginError, TakeError
from kinefit.fitting.tracking import run as running
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, key_of
from kinefit.readers import plugins
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.motion import read_motion
from kinefit.readers.take import kinds
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import squat_and_wave
from kinefit.takes.batch.many import track_takes
from kinefit.takes.batch.one import Choices
from kinefit.takes.check import check_take
from kinefit.takes.track import track_take

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
        file = self.folder / "kinefit_insole.py"
        file.write_text(text)
        # Python knows compiled code by the size and the second of its source: two changes may share both.
        Path(importlib.util.cache_from_source(file)).unlink(missing_ok=True)

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
    assert re.search(r"^\[\[insole\]\] +# of the plug-in kinefit-insole 0\.1: pressure under the foot", text, re.M)
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


@pytest.fixture
def here(plugin, monkeypatch):
    """The plug-in in this process: a function that changes its code, which is then imported anew."""
    monkeypatch.syspath_prepend(str(plugin.folder))

    def change(*pairs):
        plugin.change(*pairs)
        forget()

    def forget():
        sys.modules.pop("kinefit_insole", None)
        importlib.invalidate_caches()
        for found in (plugins.installed, plugins._record):
            found.cache_clear()

    forget()
    yield change
    monkeypatch.undo()
    forget()


@pytest.fixture
def short(recording):
    """The recording with a dozen steps and a body that is not sized, for tests of the fit."""
    recording.write_text(recording.read_text().replace("[take]\n", "[take]\nframes = [0, 12]\nsize = false\n", 1))
    return recording


def refused(action, take, *words):
    """The text of an error that names the plug-in, the take file, the table and what to do."""
    with pytest.raises(PluginError) as caught:
        action(take)
    error = caught.value
    assert re.search(NAMED, error.problem), error.problem
    assert Path(error.file) == take and "insole" in error.place and error.remedy
    for word in words:
        assert re.search(word, str(error)), str(error)


def loaded(take):
    return load_observations(read_take(take))


def tracked(take):
    return track_take(take, smooth=False)


END = "\nKIND = SensorKind("
IMPORT = '"""Insoles that measure pressure'


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (
            (END, "\nraise ValueError('broken')" + END),
            ("cannot be imported", "ValueError.*kinefit_insole.py, line.*broken"),
        ),
        (
            ("from msgspec import Meta", "from msgspec import Meta\nimport absent_package"),
            ("needs the package 'absent_package'", "pip install absent_package"),
        ),
        (("from msgspec import Meta", "from msgspec import Meta, absent"), ("cannot be imported", "ImportError")),
        ((END, "\nimport kinefit_insole.absent" + END), ("cannot be imported",)),
        ((END, "\nKIND = 1\nOTHER = SensorKind("), ("is no SensorKind",)),
        (
            ("class InsoleEntry(TakeEntry, frozen=True, kw_only=True)", "@dataclass(kw_only=True)\nclass InsoleEntry"),
            ("is no SensorKind",),
        ),
        (('table="insole"', 'table="sole"'), ("has the table 'sole', not 'insole'",)),
    ],
)
def test_a_plugin_that_cannot_be_imported(here, recording, pair, words):
    here(pair)
    refused(read_take, recording, *words)


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (
            ("    time, heel, toe = ", "    raise KeyError('cells')\n    time, heel, toe = "),
            ("`read`", "raised KeyError in read .*line"),
        ),
        (("def read(entry, name, cameras):", "def read(entry, name):"), ("`read`", "TypeError: read.. takes 2")),
        (
            ("return InsoleRecording(name,", "return InsoleRecording(name + 'x',"),
            ("returned a InsoleRecording from `read`, not a SensorRecording of the sensor 'insole'",),
        ),
        (("    return InsoleRecording(", "    return ("), ("returned a tuple from `read`, not a SensorRecording",)),
    ],
)
def test_a_plugin_whose_reading_fails(here, recording, pair, words):
    here(pair)
    refused(loaded, recording, *words)


def test_a_plugin_that_a_wrong_file_stops(here, recording):
    here()
    (recording.parent / "insole_right.csv").write_text("time_s,heel,toe\n0,1,x\n")
    refused(loaded, recording, "raised ValueError in read", "could not convert string")


PREPARED = [
    (
        "        return Pressure(self.sensor, float(self.times[i]), loaded, self.up)",
        "        at = self.sensor, float(self.times[i])\n        return Load(*at, Pressure(*at, loaded, self.up))"
        "\n\n@dataclass\nclass Load:\n    sensor: str\n    time: float\n    pressure: object",
    ),
    ("        return frame\n", "        return frame.pressure\n"),
]


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        (
            [
                (
                    "sensor=lambda entry, recording, body: Insole(recording.sensor)",
                    "sensor=lambda entry, recording, body: 1",
                )
            ],
            ("returned a int from `sensor`, not a Sensor of the name 'insole'",),
        ),
        (
            [
                (
                    "sensor=lambda entry, recording, body: Insole(recording.sensor)",
                    "sensor=lambda entry, recording, body: 1 / 0",
                )
            ],
            ("`sensor`", "raised ZeroDivisionError in <lambda>"),
        ),
        (
            [PREPARED[0], ("        return frame\n", "        return 1 / 0\n")],
            ("raised ZeroDivisionError in Insole.prepare",),
        ),
        (
            [PREPARED[0], ("        return frame\n", "        return 1\n")],
            ("failed: .*prepare.*is a int, not a Measurement",),
        ),
        (
            [("        loaded = tuple(", "        1 / 0\n        loaded = tuple(")],
            ("ZeroDivisionError in InsoleRecording.frame",),
        ),
        (
            [("        return RowsOf(", "        1 / 0\n        return RowsOf(")],
            ("ZeroDivisionError in Pressure.match",),
        ),
        (
            [("        return scene.along(", "        1 / 0\n        return scene.along(")],
            ("ZeroDivisionError in Pressure.rows",),
        ),
        (
            [
                (
                    "        return scene.along(points, self.up, -scene.positions(points) @ self.up, 0.005)",
                    "        rest = np.zeros((2, 3)), np.eye(3)[:2], np.zeros(2), np.ones(2)\n"
                    "        return Rows.of(points.segments + 99, *rest)",
                ),
                ("import Measurement, RowsOf,", "import Measurement, Rows, RowsOf,"),
            ],
            ("failed: sensor 'insole' has rows on segment 1[01].; body 'humanoid' has",),
        ),
    ],
)
def test_a_plugin_that_fails_while_it_tracks(here, short, pairs, words):
    here(*pairs)
    refused(tracked, short, *words)


def test_a_check_that_fails_is_a_finding(here, recording):
    here(("    if not recording.loaded.any():", "    if 1 / 0:"))
    found = [finding for finding in check_take(recording).findings if "kinefit-insole 0.1" in finding.text]
    assert len(found) == 1 and "`check`" in found[0].text and "ZeroDivisionError in check" in found[0].text


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ((END, "\nraise ValueError('broken')" + END), "cannot be imported.*ValueError"),
        (("    for file in files:", "    for file in 1 / 0:"), "ZeroDivisionError in propose"),
        (("yield Proposal(", "yield file  # ("), "returned a list from `propose`, not proposals"),
    ],
)
def test_init_goes_on_without_a_plugin_that_fails(here, recording, pair, words):
    here(pair)
    guess = guess_take(recording.parent)
    notes = [note.text for note in guess.notes if note.about == "insole"]
    assert len(notes) == 1 and re.search(f"{NAMED} .*({words})", notes[0]) and "[[insole]]" not in guess.text


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("least = -1", r"insole_right|\[\[insole\]\] 1: least = -1.*Give newtons, above 0"),
        ('least = "much"', "number is expected.*Write a number, without quotes"),
        ("weight = 3", "no key 'weight'; there are: file, foot, time_offset, least"),
    ],
)
def test_keys_of_a_plugin_are_checked_as_those_of_kinefit(here, recording, line, words):
    recording.write_text(recording.read_text() + line + "\n")
    with pytest.raises(TakeError, match=words) as caught:
        read_take(recording)
    assert caught.value.file == recording and "[[insole]] 1" in caught.value.place


def test_a_file_of_a_plugin_that_is_missing_or_named_twice(here, recording):
    text = recording.read_text()
    recording.write_text(text + '\n[[insole]]\nfile = "insole_right.csv"\nfoot = "right"\n')
    with pytest.raises(TakeError, match="insole insole_right.csv: the same file twice"):
        read_take(recording)
    recording.write_text(text + '\n[[insole]]\nfile = "insole_right.csv"\nfoot = "left"\n')
    assert [one.recording.sensor for one in loaded(recording).sensors] == ["insole 1", "insole 2"]
    (recording.parent / "insole_right.csv").unlink()
    with pytest.raises(FileError, match="insole insole_right.csv: no such file"):
        read_take(recording)


def test_an_insole_alone_gives_no_first_pose(here, tmp_path, recording):
    recording.write_text('[take]\nrate = 30\n[[insole]]\nfile = "insole_right.csv"\nfoot = "right"\n')
    with pytest.raises(TakeError, match=r"\[\[insole\]\]: it alone does not determine the first pose"):
        track_take(recording)


def test_a_kind_that_is_not_installed(recording):
    text = recording.read_text()
    words = r"there are: .*tracker.*install the plug-in that adds this table\."
    with pytest.raises(TakeError, match=f"no sensor or table 'insole'; {words}"):
        read_take(recording)
    recording.write_text(text.replace("[[insole]]", "[[insole]]    # of the plug-in kinefit-insole 0.1: pressure"))
    with pytest.raises(TakeError, match=r"-m pip install kinefit-insole\.") as caught:
        read_take(recording)
    assert caught.value.file == recording and caught.value.place == "[insole]"


@pytest.mark.parametrize(
    ("name", "point", "file", "words"),
    [
        (
            "kinefit-other",
            "tracker",
            '[[tracker]]\nfile = "a"\npoints = { a = "b" }\n',
            "entry point 'tracker'.* name of kinefit's own table .*pip uninstall kinefit-other",
        ),
        (
            "kinefit-other",
            "keypoints",
            '[[keypoints]]\ncamera = "a"\n',
            "entry point 'keypoints'.* name of kinefit's own table .*pip uninstall kinefit-other",
        ),
        (
            "kinefit-other",
            "insole",
            '[[insole]]\nfile = "a"\nfoot = "left"\n',
            "has the same name as kinefit-(other|insole) 0.1.*pip uninstall kinefit-(other|insole)",
        ),
    ],
)
def test_a_plugin_with_a_name_that_is_taken(here, tmp_path, monkeypatch, name, point, file, words):
    info = tmp_path / "site" / "kinefit_other-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(f"[kinefit.sensors]\n{point} = kinefit_other:KIND\n")
    monkeypatch.syspath_prepend(str(info.parent))
    here()
    take = tmp_path / "take.toml"
    take.write_text(file)
    with pytest.raises(PluginError, match=words) as caught:
        read_take(take)
    assert caught.value.file == take and point in caught.value.place


COUNTING = [
    PREPARED[0],
    (
        "        self.name = name\n",
        "        self.name, self.count, self.state_attributes = name, 0, ('count',)\n"
        "\n    def learn(self, measurement, scene, sure):\n        self.count = self.count + 1\n",
    ),
    (
        "        return frame\n",
        "        frame.pressure.up = (1.0 + 0.1 * self.count) * frame.pressure.up\n        return frame.pressure\n",
    ),
]


class Killed(BaseException):
    """As nothing in kinefit expects."""


def test_a_killed_run_goes_on_with_the_state_of_the_plugin(here, short, tmp_path, monkeypatch):
    here(*COUNTING)
    monkeypatch.setattr(running, "_EVERY", 4)
    take = read_take(short)
    steps = []

    def progress(what, done, _):
        steps.append(done if what == "frames" else 0)
        if steps.count(10) == 1 and done == 10:
            raise Killed

    def followed(**more):
        of_take = [kinds.KINDS.get(table) for table in take.sensors]
        with Checkpoint(tmp_path / "unfinished", key_of(take), kinds=of_take) as unfinished:
            return track_take(take, smooth=False, checkpoint=unfinished, **more)[0]

    with pytest.raises(Killed):
        followed(progress=progress)
    steps.clear()
    again = followed(progress=lambda what, done, _: steps.append(done) if what == "frames" else None)
    assert min(steps) == 9
    whole = track_take(take, smooth=False)[0]
    assert np.array_equal(again.angles, whole.angles) and np.array_equal(again.Ts_world_root, whole.Ts_world_root)
    assert again.residuals["insole"].values.tobytes() == whole.residuals["insole"].values.tobytes()
    old = key_of(take)
    here(*PREPARED)
    kinds.KINDS.get("insole")
    assert key_of(take) != old


def test_a_state_that_cannot_be_stored_is_named(here, short, tmp_path):
    here(
        (
            "        self.name = name\n",
            "        self.name, self.state_attributes, self.made = name, ('made',), object()\n",
        )
    )
    take = read_take(short)
    of_take = [kinds.KINDS.get(table) for table in take.sensors]
    with Checkpoint(tmp_path / "unfinished", key_of(take), kinds=of_take) as unfinished:
        refused(
            lambda take: track_take(take, smooth=False, checkpoint=unfinished),
            short,
            "failed: sensor 'insole' has a state that cannot be stored: a object",
        )
    with (
        pytest.raises(ObservationError, match="custom sensors that are no kinds"),
        Checkpoint(tmp_path / "o", "") as none,
    ):
        track_take(take, smooth=False, checkpoint=none)


def test_many_takes_with_a_plugin(here, short, tmp_path, monkeypatch):
    monkeypatch.setenv(
        "PYTHONPATH",
        os.pathsep.join([str(kinds.KINDS.plugins("insole")[0].point.dist.locate_file("")), str(ROOT / "src")]),
    )
    choices = Choices(formats=("csv",), report=False, overlays=False, smooth=False)
    (row,) = track_takes(str(short), tmp_path / "out", choices=choices)
    assert row.status == "done", row


def test_the_page_explains_every_part_of_a_kind():
    page = (ROOT / "docs" / "own-sensor.md").read_text("utf-8")
    for part in fields(kinds.SensorKind):
        assert part.name == "plugin" or re.search(rf"^\| .*`{part.name}\b.*` \|", page, re.M), part.name


@pytest.mark.parametrize("table", kinds.BUILT_IN)
def test_kinds_of_kinefit_keep_the_rules_of_plugins(table):
    kind = kinds.KINDS.get(table)
    assert kind.table == table and issubclass(kind.entry, kinds.TakeEntry) and kind.summary and kind.plugin is None


def test_nothing_is_imported_before_a_take_names_it():
    code = "import sys, kinefit.readers.take.file; print([m for m in sys.modules if m.startswith('kinefit.sensors')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


NESTED = [
    ("        return Pressure(self.sensor, float(self.times[i]), loaded, self.up)",
     "        return Pressure(self.sensor, float(self.times[i]), Cells(loaded), self.up)\n\n"
     "@dataclass\nclass Cells:\n    names: tuple"),
    ("select(self.loaded)}, channels=self.loaded)", "select(self.loaded.names)}, channels=self.loaded.names)"),
]  # fmt: skip


def test_records_in_a_measurement_are_stored_where_the_kind_lists_them(here, short, tmp_path):
    take = read_take(short)

    def stored(folder, *pairs):
        here(*NESTED, *pairs)
        with Checkpoint(tmp_path / folder, key_of(take), kinds=kinds.kinds_of(take)) as unfinished:
            return track_take(take, smooth=False, checkpoint=unfinished)[0]

    with pytest.raises(ObservationError, match="cannot store a custom Cells.*`records` of its SensorKind"):
        stored("a")
    assert "insole" in stored("b", ("propose=propose,\n", "propose=propose, records=(Cells,),\n")).residuals
