"""Everyday slips of a user: each is answered with what would work, and printed commands work when pasted."""

import re
import shlex

import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.exporters import write_motion
from kinefit.readers.take.file import read_take
from kinefit.simulation import cut, squat_and_wave

TWICE = '\n[[keypoints]]\ncamera = "cam01"\nfile = "mediapipe_cam01.npy"\nformat = "mediapipe"\nsigma = 3.0\n'


def run(*args):
    return CliRunner().invoke(main, [str(arg) for arg in args])


def commands(text):
    """Words of every command line that a text shows."""
    return [shlex.split(line.strip())[1:] for line in re.findall(r"^ *kinefit .*$", text, re.M)]


@pytest.mark.parametrize(("typed", "meant"), [("trak", "track"), ("tarck", "track"), ("Export", "export")])
def test_a_mistyped_command_names_the_nearest(typed, meant):
    told = run(typed, "take.toml")
    assert told.exit_code == 2 and f"Did you mean '{meant}'?" in told.stderr


def test_a_command_like_no_other_is_answered_with_all():
    told = run("xyz")
    assert told.exit_code == 2 and "There are: demo, init" in told.stderr


def test_a_folder_stands_for_the_take_in_it(take):
    told = run("check", take.parent)
    assert told.exit_code == 0, told.output
    assert take.with_name("take-check.html").is_file()


def test_a_folder_without_a_take_is_answered_with_init(take, monkeypatch):
    take.unlink()
    folder = take.parent.rename(take.parent.with_name("my take"))
    monkeypatch.chdir(folder.parent)
    told = run("check", "my take")
    assert told.exit_code == 2 and "no take file in this folder" in told.stderr
    assert "kinefit init 'my take'" in told.stderr
    told = run("track", "my take", "--no-overlays", "--no-report")
    assert told.exit_code == 0 and (folder / "take.toml").is_file() and "Later runs of track use it" in told.stdout


def test_several_takes_in_a_folder_are_named(take):
    text = take.read_text()
    take.unlink()
    for name in ("monday.toml", "tuesday.toml"):
        take.with_name(name).write_text(text)
    told = run("track", take.parent)
    assert told.exit_code == 2 and "2 take files in this folder: monday.toml, tuesday.toml" in told.stderr
    take.with_name("tuesday.toml").unlink()
    assert read_take(take.parent).path.name == "monday.toml"


@pytest.mark.parametrize(
    ("name", "told"),
    [("cam01.mp4", "kinefit track take.toml"), ("walk.c3d", "kinefit markers fit walk.c3d"),
     ("motion.npz", "kinefit view motion.npz")],
)  # fmt: skip
def test_another_file_than_a_take_is_answered_with_its_command(take, monkeypatch, name, told):
    monkeypatch.chdir(take.parent)
    take.with_name(name).touch()
    answer = run("track", name)
    assert answer.exit_code == 2 and told in answer.stderr


@pytest.mark.parametrize("words", [("check",), ("calibrate", "people")])
def test_a_video_is_answered_with_the_command_that_was_asked_for(take, monkeypatch, words):
    monkeypatch.chdir(take.parent)
    answer = run(*words, "cam01.mp4")
    assert answer.exit_code == 2 and f"kinefit {' '.join(words)} take.toml" in answer.stderr


def test_a_video_alone_is_answered_with_init(take, monkeypatch):
    take.unlink()
    monkeypatch.chdir(take.parent)
    told = run("track", "cam01.mp4").stderr
    assert "kinefit init ." in told and "kinefit detect cam01.mp4" in told
    assert f"kinefit init {take.parent}" not in run("init", "cam01.mp4").stderr
    assert "kinefit init ." in run("init", "cam01.mp4").stderr


def test_init_prints_commands_that_work_where_the_user_is(take, monkeypatch):
    take.unlink()
    folder = take.parent.rename(take.parent.with_name("my take"))
    monkeypatch.chdir(folder.parent)
    told = run("init", "my take")
    assert commands(told.stdout) == [["check", "my take/take.toml"], ["track", "my take/take.toml"]]
    assert run(*commands(told.stdout)[0]).exit_code == 0


def test_after_refine_the_next_command_works_as_printed(take, change, monkeypatch):
    path = take.with_name("calibration.toml")
    pattern = r"(?ms)(^\[cam02\].*?^rotation = \[)([^,]*)"
    path.write_text(re.sub(pattern, lambda m: f"{m[1]}{float(m[2]) + 0.03}", path.read_text(), count=1))
    change(take, "[take]\n", "[take]\nframes = [0, 30]\n")
    folder = take.parent.rename(take.parent.with_name("my take"))
    monkeypatch.chdir(folder.parent)
    told = run("check", "my take/take.toml", "--refine")
    assert "kinefit check 'my take/take.toml' --refine" in told.stdout  # the remedy of the fault
    words = commands(told.stdout)[-1]
    assert words == ["track", "my take/take_refined.toml"]
    assert run(*words, "--no-overlays", "--no-report", "--formats", "motion").exit_code == 0


def test_a_calibration_that_cannot_be_put_into_the_take_says_what_to_write(take, change):
    path = take.with_name("calibration.toml")
    pattern = r"(?ms)(^\[cam02\].*?^rotation = \[)([^,]*)"
    path.write_text(re.sub(pattern, lambda m: f"{m[1]}{float(m[2]) + 0.01}", path.read_text(), count=1))
    change(take, "[take]\n", "[take]\nframes = [0, 30]\n")
    text = take.read_text().replace('[calibration]\nfile = "calibration.toml"\n', "")
    take.write_text('calibration = { file = "calibration.toml" }\n' + text)
    told = run("check", take, "--refine")
    assert told.exit_code == 2 and 'file = "calibration_refined.toml" in [calibration]' in told.stderr
    assert not take.with_name("take_refined.toml").exists()


def test_one_camera_is_told_from_the_start(take, tmp_path):
    for camera in ("cam02", "cam03", "cam04"):
        take.with_name(f"{camera}.mp4").unlink()
        take.with_name(f"mediapipe_{camera}.npy").unlink()
    take.unlink()
    told = run("init", take.parent)
    assert told.exit_code == 0 and "cam01 alone: the built-in detector estimates depth" in told.stdout
    video = take.read_text()
    keypoints = '[[keypoints]]\ncamera = "cam01"\nfile = "mediapipe_cam01.npy"\nformat = "mediapipe"\n'
    take.write_text(f"{video}\n{keypoints}")
    told = run("track", take, "--out", tmp_path / "out")
    assert told.exit_code == 2 and "two cameras do" in told.stderr and "[[depth]]" in told.stderr
    take.with_name("calibration.toml").unlink()
    take.unlink()
    take.with_name("mediapipe_cam01.npy").unlink()
    told = run("init", take.parent)
    assert told.exit_code == 0 and "cam01.mp4 alone" in told.stdout and "state height" in told.stdout
    assert "field_of_view = 64.0" in take.read_text() and "[calibration]" not in take.read_text()
    told = run("check", take)
    assert told.exit_code == 0 and "nothing to check it against" in told.stdout


@pytest.mark.parametrize(
    "words",
    [("track", "{take}", "--out", "{file}"), ("check", "{take}", "--out", "{folder}"),
     ("check", "{take}", "--out", "{file}/page.html"), ("init", "{folder}", "--force", "--out", "{file}/take.toml"),
     ("export", "none.npz", "--to", "bvh", "--out", "{folder}"),
     ("export", "none.npz", "--to", "csv", "--out", "{file}"), ("gait", "none.npz", "--out", "{file}"),
     ("view", "{take}", "--html", "{folder}"), ("calibrate", "people", "{take}", "--out", "{file}/c.toml"),
     ("retarget", "none.bvh", "--out", "{folder}"), ("markers", "learn", "none.c3d", "--out", "{folder}"),
     ("markers", "identify", "none.c3d", "none.json", "--out", "{folder}"),
     ("detect", "none.mp4", "--out", "{file}"),
     ("markers", "fit", "none.c3d", "--out", "{file}"), ("simulate", "none.npz", "--out", "{file}")],
)  # fmt: skip
def test_an_out_that_cannot_be_written_is_refused_before_any_work(take, words):
    names = {"take": take, "file": take.with_name("calibration.toml"), "folder": take.parent}
    told = run(*(word.format(**names) for word in words))
    assert told.exit_code == 2 and "in the way" in told.stderr, told.output
    assert "Give another" in told.stderr and words[-2] in told.stderr


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["--to", "csv", "unit=mm"], "Did you mean --unit mm?"), (["--to", "csv", "unit", "=", "mm"], "--unit mm?"),
        (["to", "bvh"], "Did you mean --to bvh?"), (["--to", "bvh", "-out", "x.bvh"], "Did you mean --out x.bvh?"),
        ([], "Give --to [csv|"), (["--to", "trc", "--unit", "ells"], "Error: --unit ells is not possible for trc."),
    ],
)  # fmt: skip
def test_an_option_without_its_dashes_is_recognised(tmp_path, words, meant):
    told = run("export", tmp_path / "motion.npz", *words)
    assert told.exit_code == 2 and meant in told.stderr


def test_a_folder_of_results_stands_for_the_motion_in_it(tmp_path):
    write_motion(cut(squat_and_wave(), 0, 4), tmp_path / "motion.npz")
    assert run("export", tmp_path, "--to", "bvh").exit_code == 0
    assert (tmp_path / "motion.bvh").is_file()


@pytest.mark.parametrize(
    ("words", "told"),
    [(("calibrate", "baar"), "Did you mean 'bar'?"), (("markers", "ident"), "Did you mean 'identify'?"),
     (("body", "xyz"), "There are: check, copy, picture, refine."),
     (("calibrate", "bar", "x"), "'--length'. Give --length M."),
     (("calibrate", "bar", "--length", "1"), "'VIDEO_FOLDER_OR_CSV...'.")],
)  # fmt: skip
def test_commands_of_a_group_are_told(words, told):
    answer = run(*words)
    assert answer.exit_code == 2 and answer.stderr.rstrip().endswith(told)


def test_a_bar_is_checked_before_any_work(take, tmp_path):
    for words, told in (
        ([take.parent, "--length", "900"], "a bar of 900 m\n    at length\n   try Give it in metres, such as 0.9"),
        ([take.parent, "--length", "90"], "such as 0.9"),
        ([take.with_name("cam01.mp4"), "--length", "0.9"], "1 camera: a bar calibrates two or more together"),
    ):
        answer = run("calibrate", "bar", *words, "--out", tmp_path / "c.toml")
        assert answer.exit_code == 2 and told in answer.stderr and "finding targets" not in answer.stderr, answer.stderr


def test_who_is_followed_is_told_of_the_option(take):
    told = run("track", take, "--person", "moveing").stderr
    assert "at --person" in told and '"moving"' in told and "[take]" not in told


def test_formats_may_stand_apart():
    from kinefit.cli.tracking.track import chosen_formats

    assert chosen_formats(None, None, "csv bvh, GLB csv") == ("csv", "bvh", "glb")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [("up = ", 'unit = "mm"\nup = ', "'unit' belongs to [calibration], [[markers]], [[depth]]"),
     ("rate = 30.0", "rate = 35.0", "Remove rate from [take]: the videos state theirs"),
     ("[[camera]]", "[camera]", "write [[camera]], the first one too"),
     ('format = "mediapipe"', 'format = "openpose"', 'Write format = "mediapipe"'),
     ("mediapipe_cam02.npy", "mediapipe_cam01.npy", "mediapipe_cam01.npy is also the file of camera cam02"),
     ("cam02.mp4", "cam01.mp4", "cam01.mp4 is also the file of camera cam02"), ("", TWICE, "the same file twice")],
)  # fmt: skip
def test_slips_of_a_take_are_told(take, old, new, told):
    text = take.read_text()
    take.write_text(text.replace(old, new) if old else text + new)
    answer = run("track", take)
    assert answer.exit_code == 2 and told in answer.stderr


def test_check_of_one_camera_says_that_one_is_too_few(take):
    text = take.read_text()
    start, *tables = re.split(r"(?m)^(?=\[\[)", text)
    take.write_text(start + "".join(table for table in tables if "cam01" in table))
    told = run("check", take)
    assert "Keypoints of one camera do not give a person's distance; two cameras do" in told.stdout


def test_a_take_of_any_table_is_found_in_its_folder(take):
    text = take.read_text() + '[session]\nsubject = "P07"\n'
    take.unlink()
    take.with_name("monday.toml").write_text(text)
    assert read_take(take.parent).path.name == "monday.toml"


def test_another_file_than_a_motion_is_answered_with_its_command(take, monkeypatch):
    monkeypatch.chdir(take.parent)
    for name, told in (("take.toml", "kinefit track take.toml"), ("cam01.mp4", "that `kinefit track` wrote")):
        answer = run("export", name, "--to", "bvh")
        assert answer.exit_code == 2 and told in answer.stderr and "Zip" not in answer.stderr


def test_units_and_axes_of_an_export_are_spelled_as_people_do(tmp_path):
    write_motion(cut(squat_and_wave(), 0, 4), tmp_path / "motion.npz")
    told = run("export", tmp_path, "--to", "trc", "--unit", "Millimetres", "--up", "Z", "--out", tmp_path / "a.trc")
    assert told.exit_code == 0 and "unit mm, up z" in told.stdout
    told = run("export", tmp_path, "--to", "trc", "--unit", "inch")
    assert told.exit_code == 2 and "Give one of: m, cm, mm." in told.stderr


def test_static_points_are_looked_for_before_any_work(take):
    told = run("check", take, "--refine", "--points", "nothing.toml")
    assert told.exit_code == 2 and "no such file: nothing.toml" in told.stderr and not told.stdout


def test_a_take_of_an_editor_of_windows_is_read(take):
    text = take.read_text()
    take.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert read_take(take).rate == 30.0
    take.write_bytes(text.encode("utf-16"))
    told = run("check", take)
    assert told.exit_code == 2 and "UTF-8" in told.stderr
    take.unlink()
    take.with_name("monday.toml").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_take(take.parent).path.name == "monday.toml"


@pytest.mark.parametrize("words", [("track",), ("init",), ("check",), ("view",), ("export", "--to", "bvh"), ("app",)])
def test_an_address_is_no_file(words):
    told = run(words[0], "https://example.org/walk.mp4", *words[1:])
    assert told.exit_code == 2 and "is an address" in told.stderr and "Download it" in told.stderr


@pytest.mark.parametrize("words", [("track",), ("init",)])
def test_several_files_belong_into_a_folder(take, words):
    told = run(*words, take.with_name("cam01.mp4"), take.with_name("cam02.mp4"))
    assert told.exit_code == 2 and "folder of its own" in told.stderr
    assert "folder of its own" not in run("track", take, "--no-report", "nonsense").stderr


def test_a_take_with_a_hidden_ending_is_named(take):
    take.rename(take.with_name("take.toml.txt"))
    told = run("check", take.parent)
    assert told.exit_code == 2 and "Rename take.toml.txt to take.toml" in told.stderr


@pytest.mark.parametrize("words", [("calibrate", "people"), ("markers", "fit")])
def test_an_impossible_height_says_how_to_write_it(take, words):
    told = run(*words, take, "--height", "17,5")
    assert told.exit_code == 2 and "metres or centimetres: 1.75 or 175" in told.stderr


def test_a_folder_around_results_names_them(tmp_path):
    write_motion(cut(squat_and_wave(), 0, 2), tmp_path / "take-kinefit" / "motion.npz")
    told = run("export", tmp_path, "--to", "bvh")
    assert told.exit_code == 2 and "take-kinefit" in told.stderr
    assert run("export", tmp_path / "take-kinefit", "--to", "bvh").exit_code == 0
