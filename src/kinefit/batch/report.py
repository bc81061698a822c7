"""Write report.html of a tracked take: images from the videos, and provenance."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinefit.batch.results import Step

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from kinefit.motion import Motion
    from kinefit.readers.take.file import Take
    from kinefit.readers.take.load import Observations

_PACKAGES = ("kinefit", "numpy", "numba", "opencv-python-headless", "av")


def write_track_report(
    motion: Motion, take: Take, seen: Observations, folder: Path, step: Step, files: dict[str, Path],
    pictures: str = "full", notes: Iterable[str] = (),
) -> None:  # fmt: skip
    """Write report.html into a folder of results, with links to `files`; it is added to them.

    Parameters
    ----------
    pictures : "full" or "none"
    notes : sentences for the user
    """
    from kinefit.batch.results import DESCRIPTIONS
    from kinefit.exporters.report.cycles import read_norms
    from kinefit.exporters.report.report import write_report

    norms = read_norms(take.session.norms) if take.session.norms else None
    shown = {} if pictures == "none" else take_pictures(motion, take, seen, step)
    step("report", 0, 1)
    links = {path.relative_to(folder).as_posix(): DESCRIPTIONS.get(name, name) for name, path in files.items()}
    files["report"] = write_report(
        motion, folder / "report.html", rig=seen.rig, pictures=shown, files=links, norms=norms,
        findings=[("warning", f"{note.rstrip('.')}.", "") for note in notes],
    )
    step("report", 1, 1)


def take_pictures(
    motion: Motion, take: Take, seen: Observations, step: Step
) -> dict[str, dict[int, NDArray[np.uint8]]]:
    """{camera: {frame: image (H, W, 3) of the person with the fit drawn on it}} of the frames that a report shows.

    Frames outside a camera's video are omitted.
    """
    from kinefit.batch.results import _residuals
    from kinefit.exporters.report.flagged import close_up, report_frames
    from kinefit.preparing.faces import shown_video

    out: dict[str, dict[int, NDArray[np.uint8]]] = {}
    if seen.rig is None:
        return out
    frames = sorted(report_frames(motion))
    for number, name in enumerate(seen.videos):
        step("images", number, len(seen.videos))
        offset = next(entry.time_offset for entry in take.cameras if entry.name == name)
        given: dict[str, Any] = {"image_frame": seen.images[name], "residuals": _residuals(motion, name)}
        with shown_video(take, seen, name) as video:
            for frame in frames:
                shown = video.frame_at(motion.times[frame] - offset)
                if shown is not None:
                    picture = close_up(video.read(shown), motion, frame, seen.rig[name], **given)
                    out.setdefault(name, {})[frame] = picture
    step("images", len(seen.videos), len(seen.videos))
    return out


def provenance(take: Take, **more: Any) -> dict[str, Any]:
    """Provenance of a tracked take, for `Motion.provenance`: files, standard deviations, versions.

    `more` are further entries, such as smoothing={...} or tracking={...}.
    """
    out: dict[str, Any] = {
        "kinefit": metadata.version("kinefit"),
        "python": platform.python_version(),
        "packages": {name: version for name in _PACKAGES if (version := _version(name))},
        "take": take.path.name,
    }
    if take.calibration is not None:
        out["calibration"] = {"file": take.calibration.file.name, "unit": take.calibration.unit}
        if take.calibration.file.is_file():
            out["calibration"]["sha256"] = hashlib.sha256(take.calibration.file.read_bytes()).hexdigest()
    out["cameras"] = [
        {"name": c.name, "video": c.video.name if c.video else None, "image": c.image, "rotation": c.rotation,
         "time_offset": c.time_offset}
        for c in take.cameras
    ]  # fmt: skip
    out["keypoints"] = [
        {"camera": k.camera, "file": k.file.name if k.file else None, "format": k.format, "set": k.set,
         "accuracy": k.sigma}
        for k in take.keypoints
    ]  # fmt: skip
    if take.height:
        out["height"] = take.height
    if take.session.stated:
        out["session"] = take.session.stated
    return out | more


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
