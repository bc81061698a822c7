"""Several people in view, through the commands: each has results, one can be chosen, nobody is followed silently."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from tests.readers.two_people import COUNT, joint_gap, motions, write_take

import kinefit
from kinefit.cli import main


def run(*args):
    told = CliRunner().invoke(main, [str(arg) for arg in args])
    assert "Traceback" not in told.output
    return told


QUIET = "--no-overlays", "--no-report", "--formats", "motion,bvh"


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    return write_take(tmp_path_factory.mktemp("two"))


def test_everybody_in_view_is_tracked(take, tmp_path):
    told = run("track", take, *QUIET, "--out", tmp_path)
    assert told.exit_code == 0, told.output
    assert {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()} == {
        f"person-{k}/motion.{kind}" for k in (1, 2) for kind in ("npz", "bvh")
    }
    found = [kinefit.read_motion(tmp_path / f"person-{k}" / "motion.npz") for k in (1, 2)]
    gaps = np.array([[joint_gap(one, truth) for truth in motions()] for one in found])
    assert sorted(gaps.argmin(axis=1)) == [0, 1] and gaps.min(axis=1).max() < 0.03
    for k, one in enumerate(found, start=1):
        assert one.provenance["people"]["in view"] == 2 and one.provenance["people"]["followed"] == k
        assert f"2 people are in view; person {k} is tracked" in told.stdout


def test_a_point_that_no_camera_ever_sees(tmp_path):
    told = run("track", write_take(tmp_path, never=("HeadTop", "LBigToe")), *QUIET, "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    found = [kinefit.read_motion(tmp_path / "out" / f"person-{k}" / "motion.npz") for k in (1, 2)]
    gaps = np.array([[joint_gap(one, truth) for truth in motions()] for one in found])
    assert sorted(gaps.argmin(axis=1)) == [0, 1] and gaps.min(axis=1).max() < 0.03


def test_what_the_cameras_saw_is_read_once_for_all(take, tmp_path, monkeypatch):
    from kinefit.fitting.multiview import followed
    from kinefit.takes import in_view
    from kinefit.takes import track as module

    calls = []
    for of, name in ((module, "load_uncovered"), (in_view, "load_uncovered"), (followed, "people_of")):
        original = getattr(of, name)
        monkeypatch.setattr(of, name, lambda *a, f=original, n=name, **more: (calls.append(n), f(*a, **more))[1])
    assert run("track", take, *QUIET, "--out", tmp_path).exit_code == 0
    assert sorted(calls) == ["load_uncovered", "people_of"]


@pytest.mark.parametrize(("who", "index"), [("moving", 1), ("nearest 1.2 0.9 0", 1), ("nearest 0 0.9 0", 0)])
def test_one_is_followed_by_option_or_by_key(who, index, take, tmp_path):
    told = run("track", take, *QUIET, "--person", who, "--out", tmp_path / "option")
    assert told.exit_code == 0, told.output
    motion = kinefit.read_motion(tmp_path / "option" / "motion.npz")
    assert joint_gap(motion, motions()[index]) < 0.03
    own = take.with_name(f"{index}{who[0]}.toml")
    own.write_text(take.read_text().replace("[take]\n", f'[take]\nperson = "{who}"\n'))
    assert run("track", own, *QUIET, "--out", tmp_path / "key").exit_code == 0
    again = kinefit.read_motion(tmp_path / "key" / "motion.npz")
    np.testing.assert_array_equal(again.angles, motion.angles)


@pytest.mark.parametrize("wrong", ["0", "tallest", "nearest 1 2", "nearest 1 2 x", "-1", "nearest nan 0 0", ""])
def test_a_person_that_cannot_be_is_told(wrong, take, tmp_path):
    told = run("track", take, "--person", wrong, "--out", tmp_path / "out")
    assert told.exit_code == 2 and "--person" in told.stderr and '"moving"' in told.stderr
    assert not (tmp_path / "out").exists()


def test_a_number_too_many_is_told(take, tmp_path):
    told = run("track", take, "--person", "3", "--out", tmp_path)
    assert told.exit_code == 2 and "no person 3: 2 people are in view" in told.stderr


def test_of_one_who_cannot_be_tracked_the_others_still_are(take, tmp_path, monkeypatch):
    from kinefit.errors import TrackingError
    from kinefit.takes.batch import one as module

    original = module.track_take

    def failing(take, **more):
        if take.person == 1:
            raise TrackingError("lost", remedy="None.")
        return original(take, **more)

    monkeypatch.setattr(module, "track_take", failing)
    told = run("track", take, *QUIET, "--out", tmp_path)
    assert told.exit_code == 2 and "error: lost" in told.stderr
    assert not (tmp_path / "person-1" / "motion.npz").exists() and (tmp_path / "person-2" / "motion.npz").exists()


def test_one_report_leads_to_all(take, tmp_path, monkeypatch):
    told = run("track", take, "--no-overlays", "--formats", "motion", "--out", tmp_path)
    assert told.exit_code == 0 and "all people:" in told.output
    page = (tmp_path / "report.html").read_text()
    for k in (1, 2):
        assert f'href="person-{k}/report.html"' in page and (tmp_path / f"person-{k}" / "report.html").is_file()
    assert "2 of 2 people in view were tracked" in page and "Range of motion" in page and "<figure" not in page

    from kinefit.takes.batch.summary import Row, failed, write_people_report

    rows = [failed(Row(take="a", person=1, folder="person-1"), "nothing <of> it"), Row(take="a", person=2)]
    page = write_people_report(rows, tmp_path / "other", pictures=True).read_text()
    assert "1 of 2 people" in page and "nothing &lt;of&gt; it" in page and "href=\"person" not in page


def test_the_report_says_who_is_shown(take, tmp_path):
    told = run("track", take, "--person", "2", "--no-overlays", "--formats", "motion", "--out", tmp_path)
    assert told.exit_code == 0
    assert "2 of 2 in view" in (tmp_path / "report.html").read_text("utf-8")


def test_check_says_by_whom_it_goes(take):
    told = run("check", take)
    assert "2 people are in view; the check is by person" in told.stdout


def test_a_person_without_keypoints_has_no_use(take, tmp_path):
    path = tmp_path / "take.toml"
    path.write_text('[take]\nperson = 2\n[[markers]]\nfile = "walk.trc"\n')
    (tmp_path / "walk.trc").write_text("")
    told = run("track", path)
    assert told.exit_code == 2 and "'person' has no use without [[keypoints]]" in told.stderr


def test_one_person_alone_is_as_ever(take, tmp_path):
    for camera in take.parent.glob("cam0*"):
        for path in camera.glob("*.json") if camera.is_dir() else ():
            (tmp_path / camera.name).mkdir(exist_ok=True)
            content = json.loads(path.read_text())
            content["people"] = [one for one in content["people"] if one["person_id"] == [0]]
            (tmp_path / camera.name / path.name).write_text(json.dumps(content))
    text = take.read_text()
    (tmp_path / "take.toml").write_text(text)
    (tmp_path / "calibration.toml").write_bytes(take.with_name("calibration.toml").read_bytes())
    told = run("track", tmp_path / "take.toml", *QUIET)
    assert told.exit_code == 0 and "in view" not in told.stdout
    motion = kinefit.read_motion(tmp_path / "take-kinefit" / "motion.npz")
    assert len(motion) == COUNT and "people" not in motion.provenance
    assert joint_gap(motion, replace(motions()[0])) < 0.03
