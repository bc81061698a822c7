"""A recording as one page that needs no server: the scene with its animation in a single file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.viewers.show import Choice, Show, ViewerContent
from kinefit.viewers.stage import POLICY, open_server, quiet

MOST_FRAMES, MOST_PICTURES = 600, 240
"""Frames and camera pictures that a page holds at most, so that it stays below 10 MB and loads at once."""


def page(recording: ViewerContent, *, choice: Choice = Choice()) -> tuple[str, int]:  # noqa: B008
    """The scene with its animation as one self-contained HTML text, and the number of frames in it.

    Longer recordings are thinned out evenly to `MOST_FRAMES`; the cameras' pictures change as often as `MOST_PICTURES`
    allow.

    Raises
    ------
    ExportError
        viser is missing.
    """
    frames = chosen_frames(len(recording.times), MOST_FRAMES)
    with_pictures = chosen_frames(len(frames), max(1, MOST_PICTURES // max(len(recording.rig or ()), 1)))
    server = open_server(0)
    try:
        show = Show(server, recording)
        choice = replace(choice, follow=choice.follow or show.stage.goes_far)
        show.frame(0, choice)
        for figure in show.figures:
            figure.blank()
        serializer = server.get_scene_serializer()
        for k, i in enumerate(frames):
            show.frame(int(i), choice, pictures=k in with_pictures)
            step = frames[k + 1] - i if k + 1 < len(frames) else 1
            serializer.insert_sleep(float(step) / recording.rate)
        policy = f'<head><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        return serializer.as_html().replace("<head>", policy, 1), len(frames)
    finally:
        with quiet():
            server.stop()


def chosen_frames(count: int, most: int) -> NDArray:
    """At most `most` of `count` frames, evenly: every first, second, third ... one."""
    return np.arange(0, count, max(1, -(-count // most)))
