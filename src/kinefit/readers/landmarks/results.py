"""Read 2D keypoints of detectors that write all frames of a video into one json file: AlphaPose, COCO, MMPose."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec

from kinefit._arguments import checked
from kinefit._files import read_bytes
from kinefit.errors import ObservationError, names_file
from kinefit.observations import Keypoints
from kinefit.readers.landmarks.keypoint_sets import frame_numbers
from kinefit.readers.landmarks.keypoints import OpenPoseFrame, OpenPosePerson, decoded, people_record, with_new_keys
from kinefit.readers.plugins import FileFormat

Row = tuple[int, list[float]]  # frame, and x, y [px], confidence of each point of a person; empty if undetected
_HALPE, _HALPE_MORE = 3 * 26, (3 * 136, 3 * 68)  # numbers of a person of HALPE_26; with face and hands, with hands
_VIDEO_IMAGE = re.compile(r"(0|[1-9]\d*)\.\w+")  # name that AlphaPose gives to a frame of a video: "0.jpg"
_MAX_START_BYTES = 4096  # in which the keys of a form are


class _Person(msgspec.Struct):
    """A person of AlphaPose's results, whose form is that of COCO's."""

    image_id: str | int
    keypoints: list[float]


class _Instance(msgspec.Struct):
    """A person of MMPose."""

    keypoints: list[tuple[float, float]]
    keypoint_scores: list[float]

    def __post_init__(self) -> None:
        if len(self.keypoints) != len(self.keypoint_scores):
            raise ValueError(f"{len(self.keypoints)} points and {len(self.keypoint_scores)} scores")

    @property
    def numbers(self) -> list[float]:
        """x, y [px], score of each point."""
        return [v for point, score in zip(self.keypoints, self.keypoint_scores) for v in (*point, score)]


class _Instances(msgspec.Struct):
    frame_id: int
    instances: list[_Instance]


class _Predictions(msgspec.Struct):
    instance_info: list[_Instances]


_ALPHAPOSE = msgspec.json.Decoder(list[_Person] | dict[str, OpenPoseFrame])
_MMPOSE = msgspec.json.Decoder(list[_Instances] | _Predictions)


def _alphapose(raw: bytes) -> list[Row]:
    found = _ALPHAPOSE.decode(with_new_keys(raw))
    if isinstance(found, dict):
        people = [(name, person.pose_keypoints_2d) for name, frame in found.items() for person in frame.persons()]
    else:
        people = [(str(one.image_id), one.keypoints) for one in found]
    people = [(name, numbers[:_HALPE] if len(numbers) in _HALPE_MORE else numbers) for name, numbers in people]
    return list(zip(_frames([name for name, _ in people]), [numbers for _, numbers in people], strict=True))


def _frames(names: Sequence[str]) -> list[int]:
    """Frame of each image, from its name: of a video ("0.jpg") its number, else counted from the smallest number."""
    numbers = [int(re.findall(r"\d+", name)[-1][-18:]) if re.search(r"\d", name) else -1 for name in names]
    if min(numbers, default=0) < 0:
        problem = f"no frame number in the name of the image {names[numbers.index(-1)]!r}"
        raise ObservationError(problem, remedy="Run the detector on the video, or on images that are numbered.")
    first = 0 if all(map(_VIDEO_IMAGE.fullmatch, names)) else min(numbers, default=0)
    return [number - first for number in numbers]


def _mmpose(raw: bytes) -> list[Row]:
    found = _MMPOSE.decode(raw)
    frames = found if isinstance(found, list) else found.instance_info
    first = min((frame.frame_id for frame in frames), default=0)  # 0 or 1: all frames are in the file
    return [(f.frame_id - first, row) for f in frames for row in [one.numbers for one in f.instances] or [[]]]


@checked
@names_file
def _read(
    path: Path, *, format: str, rows_of: Callable[[bytes], list[Row]], camera: str, rate: float,
    keypoint_set: str | None = None,
) -> Keypoints:  # fmt: skip
    """The keypoints of a file, all people in the order of the file; see `read_keypoints`."""
    rows = decoded(path, rows_of, format)
    frames = frame_numbers([frame for frame, _ in rows], "frames")
    people: list[list[OpenPosePerson]] = [[] for _ in range(frames.max(initial=-1) + 1)]
    for frame, numbers in rows:
        people[frame] += [OpenPosePerson(numbers)] if numbers else []
    places = [(path, f"frame {k}, ") for k in range(len(people))]
    return people_record(people, places, path, camera, rate, keypoint_set)


def _begins(path: Path, *patterns: bytes) -> bool:
    """Whether the start of a file has one of these patterns, after spaces."""
    start = read_bytes(path, _MAX_START_BYTES).lstrip() if path.is_file() else b""
    return any(re.match(pattern, start, re.DOTALL) for pattern in patterns)


ALPHAPOSE = FileFormat(
    "all frames' people by AlphaPose (Fang et al. 2022, IEEE TPAMI 45:7157), or COCO's results", (".json",),
    partial(_read, format="alphapose", rows_of=_alphapose),
    lambda path: _begins(
        path, rb'\[\s*\{(?=.*"image_id")(?=.*"keypoints")', rb'\{\s*"[^"]*\.(?i:jpe?g|png|bmp|tiff?)"\s*:'
    ),
)
MMPOSE = FileFormat(
    "all frames' people by MMPose (OpenMMLab 2020)", (".json",), partial(_read, format="mmpose", rows_of=_mmpose),
    lambda path: _begins(path, rb'\[\s*\{\s*"frame_id"\s*:', rb'\{\s*"(?:meta_info|instance_info)"\s*:'),
)
