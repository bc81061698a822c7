"""What a viewer says of a motion and its take."""

import shutil
from dataclasses import replace

import pytest

from kinefit.exporters import write_motion
from kinefit.readers.take.file import read_take
from kinefit.simulation import cut, squat_and_wave
from kinefit.studio.viewers.viewed import gather
from kinefit.takes.batch import corrections
from kinefit.takes.batch.corrections import OUTDATED, inputs_entry, is_outdated


@pytest.fixture
def take(copy_take, tmp_path):
    return copy_take(tmp_path / "wave")


@pytest.fixture
def made_from(take):
    return {"take": take.name, **inputs_entry(read_take(take))}


def test_a_copy_comments_and_order_change_nothing(take, made_from, tmp_path):
    shutil.copytree(take.parent, tmp_path / "copy")
    copy = tmp_path / "copy" / take.name
    copy.write_text("# looked at\n\n" + copy.read_text())
    assert not is_outdated(made_from, copy) and not is_outdated(made_from, take)


@pytest.mark.parametrize("edit", [
    lambda take: corrections.set_height(take, 1.83),
    lambda take: corrections.exclude_view(take, "cam02", 3, 9),
    lambda take: corrections.exchange_sides(take, "cam02", 3, 9),
    lambda take: corrections.choose_person(take, "moving"),
])  # fmt: skip
def test_each_correction_makes_a_result_older_until_it_is_taken_back(edit, take, made_from):
    edit(take)
    assert is_outdated(made_from, take)
    corrections.undo(take)
    assert not is_outdated(made_from, take)


def test_a_click_moved_in_its_file_counts_too(take):
    corrections.add_click(take, 3, "cam01", "r_knee", (300.0, 400.0))
    made_from = {"take": take.name, **inputs_entry(read_take(take))}
    assert not is_outdated(made_from, take)
    clicks = read_take(take).clicks
    clicks.write_text(clicks.read_text().replace("400", "401"))
    assert is_outdated(made_from, take)


def test_nothing_is_said_of_other_takes_broken_ones_and_earlier_results(take, made_from):
    corrections.trim(take, 0, 20)
    assert is_outdated(made_from, take)
    assert not is_outdated({"take": take.name}, take) and not is_outdated(made_from | {"take": "other.toml"}, take)
    take.write_text("[take")
    assert not is_outdated(made_from, take) and not is_outdated(made_from, take.with_name("gone.toml"))


def test_the_viewer_says_so(take, made_from):
    motion = replace(cut(squat_and_wave(), 0, 5), name=read_take(take).name, provenance=made_from)
    write_motion(motion, take.parent / "take-kinefit" / "motion.npz")
    told = []
    gather([take.parent / "take-kinefit"], tell=told.append)
    assert not any(OUTDATED in sentence for sentence in told)
    corrections.set_height(take, 1.83)
    gather([take.parent / "take-kinefit"], tell=told.append)
    assert sum(OUTDATED in sentence for sentence in told) == 1
