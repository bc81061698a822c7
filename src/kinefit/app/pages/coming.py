"""Images of the cameras about the frame that is being computed, as a job goes on."""

from __future__ import annotations

import time
from collections.abc import Callable

from nicegui import ui

from kinefit.app.jobs import RUNNING, Job
from kinefit.app.pages.shell import link
from kinefit.readers.take.entries import CameraEntry, Take

STEP = "frames"
"""Name of the work that goes through the frames of a take."""

_INTERVAL_S = 2.0  # between two images, of one camera after the other: each costs a tenth of a second at most
_MAX_CAMERAS = 4  # of which images are shown


def coming_images(take: Take, job: Job) -> Callable[[], None]:
    """A row of images, empty until frames are computed; what is returned brings them up to date."""
    videos = [camera for camera in take.cameras if camera.video is not None and camera.video.is_file()][:_MAX_CAMERAS]
    row, images, last = ui.row().classes("w-full"), dict[str, ui.image](), [0.0, 0]

    def update() -> None:
        progress, now = job.steps.get(STEP), time.monotonic()
        if job.state != RUNNING or not videos or progress is None or now - last[0] < _INTERVAL_S:
            return
        if progress.share >= 1.0 and len(images) == len(videos):
            return
        camera = videos[int(last[1]) % len(videos)]
        last[:] = now, last[1] + 1
        source = link("/image/raw", path=camera.video, share=f"{progress.share:.4f}", **_span(take, camera))
        if camera.name in images:
            images[camera.name].set_source(source)
            return
        with row:
            image = images[camera.name] = ui.image(source).classes("w-40 min-h-[6rem]").props("no-spinner")
            image.props["alt"] = camera.name

    return update


def _span(take: Take, camera: CameraEntry) -> dict[str, float]:
    """Begin and end [s] of a camera's video that the take uses; nothing for all of it."""
    if take.frames is None or not take.rate:
        return {}
    start, stop = (step / take.rate - camera.time_offset for step in take.frames)
    return {"start": round(start, 3), "stop": round(stop, 3)}
