"""Faces left open by `--hide-faces`: 300 images of all recordings with people, drawn by a seed, counted by eye.

`python -m benchmarks.hide_faces FOLDER` writes the drawn images with faces hidden, as contact sheets; whoever looks at
them enters what they count into `hide_faces.csv`: faces visible in the image as it was recorded (a head seen from
behind or fully turned away is none, nor is a face that the recording has pixelated itself), and how many are open.
"""

from __future__ import annotations

import csv
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import amount, data, figure
from kinefit.errors import AssetError, ObservationError
from kinefit.exporters import write_montage
from kinefit.takes.preparing.detecting import DetectionJob
from kinefit.takes.preparing.faces import HiddenVideo, find_faces

SEED, IMAGES = 2611, 300
_TABLE = Path(__file__).with_name("hide_faces.csv")
_SHEET, _ROW, _HEIGHT_PX = 12, 4, 560  # images of a contact sheet, in a row of it, and height of each
_RECORDINGS = ("video_balancing_4cam", "video_two_people_4cam", "video_mono_opencap", "mv4_upperbody_caliscope")
_GOALS = {
    "hide_faces_open": ("% of faces, by eye", "<= 0.5"), "hide_faces_landmarks_open": ("%", "<= 0.5"),
    "hide_faces_time": ("s of processor for a second of video", "<= 5"),
}  # fmt: skip


def run() -> None:
    """Print every figure of hidden faces."""
    _print_counted()
    trial = data("video_balancing_4cam")
    try:
        if trial is None:
            raise ObservationError("no recording")
        shares, spent = _open_landmarks(trial)
    except (AssetError, ObservationError) as error:
        for name in list(_GOALS)[1:]:
            figure(name, None, *_GOALS[name], error.problem)
        return
    figure("hide_faces_landmarks_open", 100 * float(np.mean(shares)), *_GOALS["hide_faces_landmarks_open"])
    figure("hide_faces_time", spent, *_GOALS["hide_faces_time"])


def _print_counted() -> None:
    """What was counted by eye, where it was counted in the images that the seed draws today."""
    with _TABLE.open(newline="") as file:
        lines = [line for line in file if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    reason = "" if [(r["video"], int(r["frame"])) for r in rows] == drawn() else "the table is of other images"
    visible, left = (sum(int(row[name]) for row in rows) for name in ("visible", "open"))
    print(f"{len(rows)} images by seed {SEED}: {visible} faces visible, {left} left open")
    figure("hide_faces_open", None if reason else 100 * left / visible, *_GOALS["hide_faces_open"], reason)


def _videos() -> dict[str, Path]:
    """{path below the recordings: path} of all videos with people."""
    found = {}
    for name in _RECORDINGS:
        if (folder := data(name)) is not None:
            for path in sorted(folder.rglob("*.mp4")):
                if "calibration" not in path.parts:
                    found[path.relative_to(folder.parent).as_posix()] = path
    return found


def drawn() -> list[tuple[str, int]]:
    """Video and frame of each image that the seed draws, from every frame of every video alike; sorted."""
    from kinefit.readers.videos.video import Video

    every = []
    for name, path in _videos().items():
        with Video(path) as video:
            every += [(name, frame) for frame in range(len(video))]
    chosen = np.random.default_rng(SEED).choice(len(every), min(IMAGES, len(every)), replace=False)
    return [every[k] for k in sorted(chosen)]


def _open_landmarks(trial: Path) -> tuple[list[bool], float]:
    """Of each frame and camera of the balancing trial, whether the middle of MediaPipe's eyes and nose is in no circle.

    The landmarks were made by MediaPipe's own program. And the seconds of processor for a second of video.
    """
    shares, began, seconds = list[bool](), time.process_time(), 0.0
    for camera in amount(("cam01", "cam02", "cam03", "cam04"), ("cam03",)):
        video, span = trial / "videos" / f"{camera}.mp4", amount(None, (0.0, 0.3))
        heads = find_faces(DetectionJob(camera, video, Path(), seconds=span))
        truth = np.load(trial / f"mediapipe_landmarks_{camera}.npy")[: amount(None, 18), [0, 2, 5]]
        seconds += len(truth) / 60
        for frame, points in enumerate(truth):
            circles = heads.at(frame)
            if circles is not None and points[:, 2].min() > 0.5:
                off = np.linalg.norm(circles[:, :2] - points[:, :2].mean(axis=0), axis=1)
                shares.append(not (off < circles[:, 2]).any())
    return shares, (time.process_time() - began) / seconds


def write_sheets(folder: Path) -> None:
    """Write the drawn images with faces hidden, `_SHEET` on each PNG, and print which is where."""
    folder.mkdir(parents=True, exist_ok=True)
    heads, sheet, rows = {}, {}, []
    for number, (name, frame) in enumerate(drawn()):
        path = _videos()[name]
        if name not in heads:
            heads = {name: find_faces(DetectionJob(name, path, Path()))}
        with HiddenVideo(path, heads[name]) as video:
            image = video.read(frame)
        top = slice(image.shape[0] // 10, image.shape[0] * 13 // 20) if image.shape[0] > image.shape[1] else slice(None)
        sheet[f"{number}"] = cv2.putText(
            np.array(image[top]), f"{number} {Path(name).stem} {frame}", (5, 40), 0, 1.2, (255, 255, 0), 3
        )
        rows.append(f"{name},{frame}")
        if len(sheet) == _SHEET or number == IMAGES - 1:
            keys = list(sheet)
            strips = []
            with tempfile.TemporaryDirectory() as part:
                for k in range(0, len(keys), _ROW):
                    file = Path(part) / f"{k}.png"
                    write_montage({key: sheet[key] for key in keys[k : k + _ROW]}, file, height=_HEIGHT_PX)
                    strips.append(cv2.imread(str(file)))
            wide = max(strip.shape[1] for strip in strips)
            strips = [cv2.copyMakeBorder(s, 0, 8, 0, wide - s.shape[1], cv2.BORDER_CONSTANT) for s in strips]
            cv2.imwrite(str(folder / f"{number // _SHEET:02d}.png"), np.concatenate(strips))
            sheet = {}
    (folder / "drawn.csv").write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    write_sheets(Path(sys.argv[1]))
