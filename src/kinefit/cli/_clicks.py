"""A take's first pose from joints that are clicked in its images, or were: `kinefit init --click`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinefit._files import regular
from kinefit.cli import _screen
from kinefit.errors import TakeError, TrackingError, choices

if TYPE_CHECKING:
    from kinefit.bodies import Body
    from kinefit.readers.annotations import Clicks
    from kinefit.readers.take.file import Take
    from kinefit.readers.take.load import Observations

_INSIDE = 1e-6  # [rad] or [m] from a joint's limits, that rounding does not cross them
_MAX_CLICK_ERROR_M = 0.1  # [m] of a clicked joint from the pose: the worst of those clicked with care is 2 to 5 cm off
_MAX_LISTED_JOINTS = 4  # joints that a warning names
BODY = "clicked-body.npz"
CLICKS = "clicks.json"


def start_from_clicks(out: Path, points: Path | None, step: int | None, body: str, browser: bool) -> None:
    """Put body and pose of clicked joints into a take file that was just written.

    Parameters
    ----------
    out : the take file
    points : clicks as JSON; None: they are clicked in the browser
    step : of the images that are shown; the first where None
    body : name or file of the body
    """
    from kinefit.bodies import load_body
    from kinefit.readers.annotations import read_clicks
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations
    from kinefit.takes.missing import last_found

    take = last_found(read_take(out))
    seen, generic = load_observations(take), load_body(body)
    if seen.rig is None or (not seen.videos and points is None):
        remedy = "Add [calibration] and videos, or leave out --click."
        raise TakeError("--click needs videos of calibrated cameras; the take has none", file=out, remedy=remedy)
    if points is not None:
        _screen.say(_started(out, take, seen, generic, read_clicks(points)))
        return
    _ask(out, take, seen, generic, seen.frames[0] if step is None else step, browser)


def _ask(out: Path, take: Take, seen: Observations, body: Body, step: int, browser: bool) -> None:
    """Show the page until its clicks give a start."""
    import webbrowser

    from kinefit.initialization.from_clicks import clickable
    from kinefit.readers.annotations import clicks_of
    from kinefit.viewers.clicks import ClickPage

    def taken(clicks: Any) -> str:
        return _started(out, take, seen, body, [clicks_of(clicks)])

    page = ClickPage(_pictures(take, seen, step), clickable(body), taken, step=step)
    try:
        _screen.say(f"Click the joints at {page.url} ; Ctrl-C ends without a [start].")
        if browser:
            webbrowser.open(page.opening())
        while not page.done.wait(0.5):
            pass
    finally:
        page.close()
    _screen.say(f"{out}: [start] written from the clicks in {out.with_name(CLICKS)}")


def _pictures(take: Take, seen: Observations, step: int) -> dict[str, bytes]:
    """JPEG of every image that cameras took at a step."""
    import cv2

    from kinefit.preparing.faces import shown_video

    if not seen.frames[0] <= step < seen.frames[1]:
        problem = f"step {step} is outside the recording's steps {seen.frames[0]} to {seen.frames[1] - 1}"
        raise TakeError(problem, file=take.path, remedy="Give one of these steps with --step.")
    out = {}
    for entry in take.cameras:
        if entry.name in seen.videos:
            with shown_video(take, seen, entry.name) as video:
                frame = video.frame_at(step / seen.rate - entry.time_offset)
                if frame is None:  # its first or last image would be of another time
                    continue
                picture = cv2.cvtColor(video.read(frame), cv2.COLOR_RGB2BGR)
            out[entry.name] = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    if len(out) < 2:
        problem = f"{len(out)} of {len(seen.videos)} cameras have an image at step {step}; --click needs two"
        raise TakeError(problem, file=take.path, remedy="With --step, give a step at which two cameras recorded.")
    return out


def _started(out: Path, take: Take, seen: Observations, body: Body, steps: Sequence[Clicks]) -> str:
    """Write body and start of the first step, and the clicks of all, to which the take file refers; what to tell."""
    import numpy as np

    from kinefit._files import write_text
    from kinefit.bodies.serial import save_body
    from kinefit.initialization.from_clicks import clickable, clicked_points, clicked_start
    from kinefit.readers.annotations import clicks_text

    assert seen.rig is not None
    clicks = steps[0]
    unknown = [camera for of in steps for camera in of.points if camera not in seen.rig.names]
    if unknown:
        raise TrackingError(choices("camera of the take", unknown[0], seen.rig.names))
    every = [name for of in clicks.points.values() for name in of]
    named = [name for step in steps for of in step.points.values() for name in of]
    strange = [name for name in named if name not in body.landmarks.names]
    if strange:
        raise TrackingError(choices(f"landmark of body '{body.name}'", strange[0], clickable(body)))
    once = [name for name in dict.fromkeys(every) if every.count(name) == 1]
    names = clicks.names
    uv = np.full((len(names), len(seen.rig), 2), np.nan)
    for c, camera in enumerate(seen.rig.names):
        places = clicks.places(camera)
        uv[:, c] = seen.images[camera].to_calibration(places) if camera in seen.images else places
    x_world, covariance = clicked_points(seen.rig, names, uv)
    fitted, state, left = clicked_start(body, names, x_world, covariance)
    save_body(fitted, out.with_name(BODY))
    tree, R = fitted.tree, state.T_world_root[:3, :3]
    angles = np.clip(state.angles, tree.lower + _INSIDE, tree.upper - _INSIDE)
    written = ", ".join(
        f"{name} = {value if slides else np.degrees(value):.6f}"
        for name, value, slides in zip(tree.coordinates, angles, tree.prismatic)
    )
    vectors = {"at": state.T_world_root[:3, 3], "forward": R[:, 0], "upward": R[:, 1]}
    lines = [f"{key} = [{', '.join(f'{v:.6f}' for v in vector)}]" for key, vector in vectors.items()]
    text = re.sub(r"\n\[start\]  # clicked\n.*?(?=\n\[|\Z)", "", regular(out).read_text("utf-8"), flags=re.S)
    text = re.sub(r"(?m)^body = .*$", f'body = "{BODY}"  # {body.name} of the clicked lengths', text, count=1)
    head = ["[start]  # clicked", f"step = {clicks.step}", f'clicks = "{CLICKS}"']
    start = "\n".join([*head, *lines, f"angles = {{ {written} }}"])
    write_text(out.with_name(CLICKS), clicks_text(steps))
    write_text(out, f"{text.rstrip()}\n\n{start}\n")
    known = np.isfinite(x_world).all(axis=1).sum()
    text = f"{known} points triangulated, {100 * left:.1f} cm from the pose (median)."
    if once:
        text += f" Not used, as clicked in one image only: {', '.join(once)}."
    off = np.linalg.norm(fitted.positions(state, fitted.landmarks.select(names)) - x_world, axis=1)
    if np.nanmax(off) > _MAX_CLICK_ERROR_M:
        worst = np.argsort(-np.nan_to_num(off))[:_MAX_LISTED_JOINTS].tolist()
        text += " Warning: no pose of this body fits the clicks; the largest errors are "
        text += ", ".join(f"{names[n]} ({100 * off[n]:.0f} cm)" for n in worst)
        text += ". Check whether left and right are swapped, in the same way in every image."
    return text
