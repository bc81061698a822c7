"""Events that a recording's file marks: compared with feet and plates, and kept through files."""

import json
from dataclasses import replace

import ezc3d
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import read_markers, read_motion, write_motion
from kinefit.bodies.motion import MarkerEvent
from kinefit.cli import main
from kinefit.exporters import write_c3d
from kinefit.exporters.gait.plates import feet_on_plates
from kinefit.exporters.gait.record import gait_record
from kinefit.exporters.report import feet
from kinefit.exporters.report.cycles import events_of
from kinefit.exporters.report.feet import foot_event, foot_findings, footing
from kinefit.exporters.report.report import write_report

TEXTS = "CONTEXTS", "LABELS", "SUBJECTS", "DESCRIPTIONS"
FOREIGN = (
    MarkerEvent("Start", 2.5, "General", "HC030A", "Begin of the trial", 0, 1, "straight.c3d"),
    MarkerEvent("Foot Strike", 3.3, "General", "HC030A", "of a crutch", 1, 0, "straight.c3d"),
    MarkerEvent("Turn", 61.23456, "Left", "", "", 7, 0, "straight.c3d"),
)


def shifted(motion, label, side, nth, seconds):
    """With one of its file's events at another time."""
    own = [event for event in motion.events if (event.label, event.context) == (label, side)]
    events = [replace(e, time=e.time + seconds) if e == own[nth] else e for e in motion.events]
    return replace(motion, events=tuple(events))


def test_a_laboratorys_own_events_contradict_nothing(walk):
    assert len(walk.events) == 8 and {event.source for event in walk.events} == {"straight.c3d"}
    assert all(foot_event(event) for event in walk.events) and not foot_findings(walk)


@pytest.mark.parametrize(
    ("label", "nth", "seconds", "said"),
    [
        ("Foot Strike", 0, 0.06, "left contact at 3.600 s (found by a plate 0.056 ± 0.006 s earlier)"),
        ("Foot Strike", 1, -0.1, "left contact at 4.480 s (found 0."),
        ("Foot Strike", 0, 0.53, "left contact at 4.070 s (there the right foot has it)"),
        ("Foot Off", 0, 0.09, "left toe-off at 3.230 s (found 0."),
    ],
)
def test_an_event_that_contradicts_is_named_with_side_time_and_file(walk, label, nth, seconds, said):
    (found,) = foot_findings(shifted(walk, label, "Left", nth, seconds))
    assert (found.severity, found.kind) == ("doubt", "events")
    assert found.text.startswith("Events of straight.c3d contradict") and said in found.text
    assert "Those found are used" in found.text and found.text.count(" at ") == 1 and found.remedy


def test_what_lies_within_the_bound_or_beyond_the_walk_is_not_named(walk):
    for seconds in (0.02, -0.02):
        assert not foot_findings(shifted(walk, "Foot Strike", "Left", 0, seconds))
    beyond = MarkerEvent("Foot Strike", float(walk.times[-1]) + 0.5, "Left")
    assert not foot_findings(replace(walk, events=(beyond, *FOREIGN)))


def test_record_and_command_name_it(walk, tmp_path):
    wrong = shifted(walk, "Foot Strike", "Left", 0, 0.06)
    assert any("left contact at 3.600 s" in note for note in gait_record({"walk": wrong}).notes)
    write_motion(wrong, tmp_path / "motion.npz")
    done = CliRunner().invoke(main, ["gait", str(tmp_path), "--json"])
    assert done.exit_code == 0 and any("left contact at 3.600 s" in note for note in json.loads(done.stdout)["notes"])


def test_feet_and_plates_are_looked_at_once(walk):
    assert footing(walk) is footing(walk)
    assert footing(walk) is not footing(replace(walk))


def test_a_report_and_a_c3d_of_one_motion_look_at_its_plates_once(walk, tmp_path, monkeypatch):
    looks, motion = [], replace(walk)
    monkeypatch.setattr(feet, "feet_on_plates", lambda *a: looks.append(a[0]) or feet_on_plates(*a))
    write_c3d(motion, tmp_path / "walk.c3d")
    write_report(motion, tmp_path / "report.html")
    gait_record({"walk": motion})
    assert len(looks) == 1 and looks[0] is motion


def group(path):
    """The EVENT group as ezc3d reads it: rows (texts .., minutes, seconds, icon, flag)."""
    found = ezc3d.c3d(str(path))["parameters"]["EVENT"]
    texts = [found[name]["value"] for name in TEXTS]
    minutes, seconds = found["TIMES"]["value"]
    numbers = [np.asarray(found[name]["value"]).tolist() for name in ("ICON_IDS", "GENERIC_FLAGS")]
    return list(zip(*texts, minutes.tolist(), seconds.tolist(), *numbers, strict=True))


def test_foreign_events_stay_bit_for_bit(walk, data_dir, tmp_path):
    motion = replace(walk, events=(*walk.events, *FOREIGN))
    write_motion(motion, tmp_path / "motion.npz")
    back = read_motion(tmp_path / "motion.npz")
    assert back.events == motion.events
    write_c3d(back, tmp_path / "once.c3d")
    again = replace(walk, events=read_markers(tmp_path / "once.c3d").events)
    write_c3d(again, tmp_path / "twice.c3d")
    once, twice = group(tmp_path / "once.c3d"), group(tmp_path / "twice.c3d")
    assert once == twice
    kept = [row for row in once if row[0] == "General" or row[1] == "Turn"]
    assert kept == [
        (e.context, e.label, e.subject, e.description, e.time // 60.0, float(np.float32(e.time % 60.0)), e.icon, e.flag)
        for e in FOREIGN
    ]
    own = [row for row in once if row not in kept]
    assert len(own) == len(footing(walk).feet.left.contacts) + len(footing(walk).feet.left.offs) + sum(
        len(times) for times in (footing(walk).feet.right.contacts, footing(walk).feet.right.offs)
    )


def test_events_of_a_real_file_come_through_a_motion_without_gait(walk, data_dir, tmp_path):
    source = data_dir("gait_biomechzoo") / "HC030A" / "straight.c3d"
    still = walk.part(slice(0, 10))
    assert events_of(still) == walk.events
    write_c3d(still, tmp_path / "still.c3d")
    assert sorted(group(tmp_path / "still.c3d")) == sorted(group(source))


def test_more_events_than_a_list_of_c3d_holds(walk, tmp_path):
    many = tuple(MarkerEvent(f"e{k}", 0.125 * k, "General") for k in range(600))
    write_c3d(replace(walk.part(slice(0, 10)), events=many), tmp_path / "many.c3d")
    back = read_markers(tmp_path / "many.c3d").events
    assert [(e.label, e.time) for e in back] == [(e.label, e.time) for e in many]
    assert ezc3d.c3d(str(tmp_path / "many.c3d"))["parameters"]["EVENT"]["USED"]["value"][0] == 600
