"""The state of the app that no file holds: whether faces are hidden, the queue of jobs, the results that are open."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from kinefit.errors import KinefitError
from kinefit.studio.app.jobs import Job, JobQueue
from kinefit.studio.app.live import Recorder
from kinefit.studio.app.people import PeoplePictures
from kinefit.studio.app.review import Comparison, FilePages, Review


class Desk:
    """What one running app has.

    Parameters
    ----------
    root : folder of the session
    prefix : of the paths of all pages: "/" and the token

    Attributes
    ----------
    hide_faces : bool or None
        The user's choice at the start; None until it is made, and nothing of a video is shown before.
    chosen : set of Path
        Folders without a take file in which the user asked for one; opening a page alone writes nothing.
    files : FilePages, which serves reports and check pages
    jobs : JobQueue
    people : PeoplePictures of all takes
    recorder : of cameras of this computer, while it records
    """

    def __init__(self, root: Path, prefix: str) -> None:
        self.root, self.prefix = root, prefix
        self.hide_faces: bool | None = None
        self.chosen: set[Path] = set()
        self.files = FilePages(root)
        self.jobs = JobQueue()
        self._open: dict[Path | tuple[Path, Path], Any] = {}
        self._opening = threading.Lock()  # of two windows that open the same result, the second waits
        self.people = PeoplePictures()
        self.recorder: Recorder | None = None

    def start(self, take: Path, *command: str) -> Job:
        """Ask for a command on a take, with the choice of faces."""
        hidden = ["--hide-faces"] * bool(self.hide_faces and command[0] in ("check", "track"))
        return self.jobs.add(take, [*command, *hidden])

    def review(self, take: Path, folder: Path) -> Review:
        """An open result; read anew if its motion was written since. Slow: call it in a thread."""
        return self._current(folder, lambda: Review(take, folder, hide_faces=bool(self.hide_faces)))

    def opened(self, folder: Path) -> Review | None:
        """The result in a folder, if it is open."""
        return self._open.get(folder)

    def comparison(self, before: Path, after: Path) -> Comparison:
        """Two results side by side; read anew if a motion was written since. Slow: call it in a thread."""
        return self._current((before, after), lambda: Comparison(before, after))

    def _current(self, key: Any, read: Callable[[], Any]) -> Any:
        with self._opening:
            known = self._open.get(key)
            if known is None or not known.is_current(bool(self.hide_faces)):
                if known is not None:
                    known.close()
                self._open[key] = known = read()
            return known

    async def close(self) -> None:
        """Pause all jobs, end the recording and close all results."""
        self.files.close()
        for result in self._open.values():
            result.close()
        if self.recorder is not None:
            with suppress(KinefitError):  # a camera without images
                self.recorder.stop()
        await self.jobs.close()
