"""Force plates in takes: with the markers of a C3D, in a file of their own, moved, and as `init` proposes them."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import (
    fit_marker_subject,
    fit_markers,
    load_body,
    load_observations,
    read_markers,
    read_motion,
    read_take,
)
from kinefit.cli import main
from kinefit.errors import FileError, KinefitError
from kinefit.exporters import write_forces, write_markers
from kinefit.readers.guess.folder import guess_take
from kinefit.studio.live.take import live_session
from kinefit.takes.check import check_take


@pytest.fixture(scope="module")
def folder(data_dir, tmp_path_factory):
    """A walk as TRC, and the forces of its plates as MOT, both y up."""
    out = tmp_path_factory.mktemp("plates")
    markers = read_markers(data_dir("gait_biomechzoo") / "HC030A" / "straight.c3d").trimmed()
    subject = fit_marker_subject(load_body("humanoid"), markers, frames=6)
    short = replace(markers, positions=markers.positions[:20], residual=None)
    motion = fit_markers(subject, short, smooth=False).turned("y")
    write_forces(motion, out / "walk_grf.mot")
    turned = markers.positions[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
    write_markers(replace(markers, positions=turned, up="y", residual=None), out / "walk.trc")
    return out


def take(folder, lines):
    file = folder / "own.toml"
    file.write_text(f'[take]\nup = "y"\nbody = "humanoid"\n[[markers]]\nfile = "walk.trc"\n{lines}')
    return read_take(file)


def test_init_proposes_the_forces(folder):
    text = guess_take(folder).text
    assert '[[plate]]\nfile = "walk_grf.mot"' in text


@pytest.mark.parametrize(
    ("line", "moved"),
    [("", [0, 0, 0]), ("shift = [0.5, 0.0, -0.2]\n", [0.5, 0.0, -0.2]), ("time_offset = 0.25\n", [0, 0, 0])],
)
def test_a_take_places_plates(folder, line, moved):
    own = load_observations(take(folder, '[[plate]]\nfile = "walk_grf.mot"\n')).plates
    plates = load_observations(take(folder, f'[[plate]]\nfile = "walk_grf.mot"\n{line}')).plates
    assert len(plates) == len(own) == 2
    for a, b in zip(own, plates):
        np.testing.assert_allclose(b.centre - a.centre, moved, atol=1e-9)
        assert b.first_time - a.first_time == pytest.approx(0.25 if "time" in line else 0.0)


def test_a_turn_turns_forces(folder):
    a, b = (
        load_observations(take(folder, f'[[plate]]\nfile = "walk_grf.mot"\n{line}')).plates[0]
        for line in ("", "turn = [0.0, 180.0, 0.0]\n")
    )
    np.testing.assert_allclose(b.force, a.force * [-1.0, 1.0, -1.0], atol=1e-6)


def test_plates_of_a_c3d_come_with_its_markers(data_dir, tmp_path):
    walk = data_dir("gait_biomechzoo") / "HC030A" / "straight.c3d"
    file = tmp_path / "take.toml"
    file.write_text(f'[take]\nup = "z"\n[[markers]]\nfile = "{walk.as_posix()}"\ntime_offset = 0.5\n')
    plates, known = load_observations(read_take(file)).plates, read_markers(walk).plates
    assert [p.name for p in plates] == ["plate 1", "plate 2"]
    assert plates[0].first_time == pytest.approx(known[0].first_time + 0.5)
    file.write_text(f'{file.read_text()}sides = "mirrored-x"\n')
    mirrored = load_observations(read_take(file))
    assert not mirrored.plates and any("mirrored, too" in note for note in mirrored.notes)


def test_a_file_without_plates_is_named(folder):
    with pytest.raises(FileError, match="no force plates"):
        write_markers(read_markers(folder / "walk.trc"), folder / "bare.c3d")
        load_observations(take(folder, '[[plate]]\nfile = "bare.c3d"\n'))


def test_what_is_named_twice_counts_once(folder):
    twice = '[[plate]]\nfile = "walk_grf.mot"\n' * 2
    seen = load_observations(take(folder, twice))
    assert len(seen.plates) == 2 and any("named twice" in note for note in seen.notes)


@pytest.mark.parametrize(
    ("line", "problem"),
    [("turn = [90.0, 0.0, 0.0]\n", "bears its load along z"), ("time_offset = 500.0\n", "its frames are from")],
)
def test_plates_of_another_world_or_time_are_refused(folder, line, problem):
    with pytest.raises(KinefitError, match=problem):
        load_observations(take(folder, f'[[plate]]\nfile = "walk_grf.mot"\n{line}'))


def test_forces_of_another_trial_are_a_comment(folder, tmp_path):
    for name in ("a.trc", "b.trc"):
        (tmp_path / name).write_bytes((folder / "walk.trc").read_bytes())
    (tmp_path / "b_grf.mot").write_bytes((folder / "walk_grf.mot").read_bytes())
    text = guess_take(tmp_path).text
    assert '# [[plate]]\n# file = "b_grf.mot"' in text and "\n[[plate]]" not in text
    (tmp_path / "b_grf.mot").rename(tmp_path / "session.mot")
    assert '\n[[plate]]\nfile = "session.mot"' in guess_take(tmp_path).text  # the only forces there


def walk_take(data_dir, folder, seconds):
    """A take of a child's walk whose file marks a contact of the left foot so much later."""
    source = data_dir("gait_biomechzoo") / "HC030A" / "straight.c3d"
    markers = read_markers(source)
    first = next(event for event in markers.events if (event.label, event.context) == ("Foot Strike", "Left"))
    events = tuple(replace(e, time=e.time + seconds) if e == first else e for e in markers.events)
    write_markers(replace(markers, events=events), folder / "walk.c3d", like=source)
    (folder / "take.toml").write_text('[take]\nup = "z"\n[[markers]]\nfile = "walk.c3d"\n')
    return folder / "take.toml"


@pytest.mark.parametrize(("seconds", "severity"), [(0.0, "good"), (0.06, "doubt")])
def test_check_compares_plates_and_events_with_the_feet(data_dir, tmp_path, seconds, severity):
    found = check_take(walk_take(data_dir, tmp_path, seconds)).findings
    (told,) = (one for one in found if one.kind in ("plates", "events"))
    assert told.severity == severity
    assert ("left contact at 3.600 s" in told.text) == (severity == "doubt")


def test_the_report_of_track_names_the_event(data_dir, tmp_path):
    take = walk_take(data_dir, tmp_path, 0.06)
    done = CliRunner().invoke(main, ["track", str(take), "-o", str(tmp_path / "out"), "--formats", "motion"])
    assert done.exit_code == 0, done.output
    assert "left contact at 3.600 s" in (tmp_path / "out" / "report.html").read_text("utf-8")
    assert read_motion(tmp_path / "out").events == read_markers(tmp_path / "walk.c3d").events


def test_a_live_replay_says_that_plates_have_no_part(data_dir, tmp_path):
    told = []
    live_session(read_take(walk_take(data_dir, tmp_path, 0.0)), tell=told.append).close()
    assert any("Force plates have no part" in text and "kinefit track" in text for text in told)
