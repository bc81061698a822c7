"""What is known of all takes of a session, from their files and results, without tracking anything again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from kinefit._files import read_npz
from kinefit.app.folders import TakeFolder, takes_below
from kinefit.errors import KinefitError
from kinefit.readers.take.file import read_take


@dataclass(frozen=True)
class SessionRow:
    """One person of one take; a take without results has one, too.

    Parameters
    ----------
    take : TakeFolder
    person : int, number of the person; 0 if the take has one
    folder : Path of the person's results; None if there are none
    session : {"subject": ..., "date": ..., "movement": ...}, what the take's `[session]` states
    problem : what is wrong with the take file; "" if nothing is
    state : of the take, as `TakeFolder.state` has it
    seconds, agreement : float [s], and mean quality, 0 to 1; None without results
    """

    take: TakeFolder
    person: int
    folder: Path | None
    session: Mapping[str, str]
    problem: str
    state: str
    seconds: float | None = None
    agreement: float | None = None


def recordings(root: Path) -> list[SessionRow]:
    """Everybody in all takes below a folder, by path."""
    found = []
    for take in takes_below(root):
        try:
            session, problem = _session(take.file, take.file.stat().st_mtime_ns), ""
        except (KinefitError, OSError) as error:
            session, problem = {}, str(error)
        people, state = take.people, take.state
        for k, folder in enumerate(people, start=1):
            number = k if len(people) > 1 else 0
            found.append(SessionRow(take, number, folder, session, problem, state, *measures(folder / "motion.npz")))
        if not people:
            found.append(SessionRow(take, 0, None, session, problem, state))
    return found


def measures(motion: Path) -> tuple[float | None, float | None]:
    """Length [s] and mean quality of a motion file; (None, None) if it cannot be read."""
    try:
        return _measures(motion, motion.stat().st_mtime_ns)
    except (KinefitError, OSError, KeyError):
        return None, None


@lru_cache(4096)
def _session(take: Path, changed: int) -> dict[str, str]:
    return read_take(take).session.stated


@lru_cache(4096)
def _measures(motion: Path, changed: int) -> tuple[float, float]:
    arrays = read_npz(motion, "rate", "quality", remedy="")
    return len(arrays["quality"]) / float(arrays["rate"]), float(arrays["quality"].mean())
