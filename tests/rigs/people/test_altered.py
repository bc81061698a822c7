"""Videos that no camera can be found from are named before cameras are sought."""

from dataclasses import replace

import numpy as np
import pytest
from tests.rigs.people.test_skeletons import LATE, seen
from tests.rigs.people_data import BODY, room
from tests.takes.test_missing import take_text

from kinefit import read_take
from kinefit.errors import CalibrationError, ObservationError
from kinefit.exporters.motion_file import write_detections
from kinefit.observations import Detections
from kinefit.observations.recordings import mirror_name
from kinefit.readers.take.load import load_observations
from kinefit.rigs.people.altered import refuse_videos


def mirrored(record, camera):
    order = [record.names.index(mirror_name(name) or name) for name in record.names]
    points = record.points[:, :, order] * [-1.0, 1.0] + [camera.size[0] - 1.0, 0.0]
    return replace(
        record, points=points, confidence=record.confidence[:, :, order],
        lifted=record.lifted[:, :, order] * [-1.0, 1.0, 1.0],
    )  # fmt: skip


def slow(record, camera):
    """Filmed at four times the rate, played at the same: every frame of ours four times."""
    points, confidence, lifted = (np.repeat(v, 4, axis=0) for v in (record.points, record.confidence, record.lifted))
    return replace(record, points=points, confidence=confidence, lifted=lifted)


def alone(record, camera):
    """Somebody is seen long after the others' videos have ended."""
    late = lambda v, empty: np.concatenate([np.full_like(v, empty), np.full_like(v, empty), v])
    return replace(
        record, points=late(record.points, np.nan), confidence=late(record.confidence, 0.0),
        lifted=late(record.lifted, np.nan),
    )  # fmt: skip


def checked(folder, change, which=1):
    for c, (camera, record) in enumerate(zip(room(), seen(LATE), strict=True)):
        record = change(record, camera) if c == which else record
        masks = np.zeros(0, np.uint32), np.zeros(len(record) + 1, int)
        write_detections(
            Detections(camera.name, 30.0, camera.size, record.points, record.confidence, *masks, "", record.lifted),
            folder / f"{camera.name}.npz",
        )  # fmt: skip
    (folder / "take.toml").write_text(take_text(f"height = {BODY.stature}"))
    refuse_videos(read_take(folder / "take.toml"))


def test_a_video_of_two_frames_is_named(tmp_path):
    cut = lambda record, camera: record.rows(slice(0, 2), 0.0)
    checked(tmp_path, cut)
    with pytest.raises(ObservationError, match="saw 2 frames") as told:
        load_observations(read_take(tmp_path / "take.toml"), exteriors=False)
    assert told.value.place == f"keypoints {room().names[1]}" and "Remove that video" in told.value.remedy


def test_right_videos_pass(tmp_path):
    checked(tmp_path, lambda record, camera: record)


@pytest.mark.parametrize(
    ("change", "problem"), [(mirrored, "is mirrored"), (slow, "4 times as slowly"), (alone, "only while no other")]
)
@pytest.mark.parametrize("which", [0, 2])
def test_a_video_of_no_use_is_named(tmp_path, change, problem, which):
    with pytest.raises(CalibrationError, match=problem) as told:
        checked(tmp_path, change, which)
    assert told.value.place == f"camera {room().names[which]}" and told.value.remedy
