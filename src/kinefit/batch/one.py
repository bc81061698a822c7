"""Track one take into a folder of results: find its people, track each, and write the results."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinefit.batch.results import DEFAULT_FORMATS, Step, write_overlays, write_results
from kinefit.errors import KinefitError, TakeError

if TYPE_CHECKING:
    from kinefit.motion import Motion
    from kinefit.preparing.each_video import Tell
    from kinefit.readers.take.file import Take
    from kinefit.takes.in_view import InView


@dataclass(frozen=True)
class Choices:
    """Choices of results for a take.

    Parameters
    ----------
    formats : of `results.NAMES`
    overlays : bool, whether overlay videos are written
    overlay_skin : bool, whether they show the person's skin, too
    report : bool, whether report.html is written
    pictures : images in report and overlays: "full" or "none"
    smooth : bool, whether the whole take is smoothed
    contacts : bool, whether soles on a level floor are constrained to rest
    lag : float [s], see `track`
    person : target person; None: the one that the take names, else every person in view
    restart : bool, whether an unfinished earlier run is discarded
    hide_faces : bool, whether all faces are hidden in images; a take may set it too
    """

    formats: tuple[str, ...] = DEFAULT_FORMATS
    overlays: bool = True
    overlay_skin: bool = False
    report: bool = True
    pictures: str = "full"
    smooth: bool = True
    contacts: bool = False
    lag: float | None = None
    person: str | None = None
    restart: bool = False
    hide_faces: bool = False

    @property
    def draws(self) -> bool:
        """Whether overlays are written."""
        return self.overlays and self.pictures != "none"


@dataclass(frozen=True, eq=False)
class TrackedPerson:
    """The tracked motion of one person of a take.

    Parameters
    ----------
    motion : Motion
    notes : sentences for the user
    total : int, number of frames of the take if Ctrl-C stopped the run before the last; else 0
    """

    motion: Motion
    notes: tuple[str, ...]
    total: int = 0


def asked_take(path: Path, choices: Choices) -> Take:
    """Read a take file, with the choices' person and hidden faces.

    Raises
    ------
    KinefitError
        The take or the named person is invalid.
    """
    from kinefit.readers.take.checks import check_enough, check_take
    from kinefit.readers.take.file import read_take

    take = read_take(path)
    take = replace(take, hide_faces=take.hide_faces or choices.hide_faces)
    if choices.person is not None:
        take = replace(take, person=choices.person)
        try:
            check_take(take)
        except KinefitError as error:  # the option's fault: the take alone is valid
            raise type(error)(error.problem, place="--person", remedy=error.remedy) from None
    check_enough(take)
    return take


def check_drawable(take: Take, *, skin: bool = False) -> None:
    """Check that a take has images for overlays, or for overlays with a skin.

    Raises
    ------
    TakeError
        It has neither videos nor depth; for a skin, no videos.
    """
    videos = any(camera.video for camera in take.cameras)
    if skin and not videos:
        problem = "the take has no video for a skin on overlays"
        raise TakeError(problem, file=take.path, remedy="Leave out --overlay-skin.")
    if not (take.depth or videos):
        raise TakeError("the take has no video or depth for overlays", file=take.path, remedy="Leave out --overlays.")


def people_of(take: Take, out: Path, step: Step, tell: Tell) -> tuple[InView | None, list[tuple[Take, Path]]]:
    """Find the people to track: the people in view (None if the take names one), and a take and a folder for each.

    What the take lacks is found first, as by `prepared`.
    """
    from kinefit.takes.in_view import people_in_view
    from kinefit.takes.missing import prepared

    take = prepared(take, step, tell)
    view = people_in_view(take) if take.person is None else None
    people = len(view.people) if view else 0
    if people < 2:
        return view, [(take, out)]
    assert view is not None
    numbers = [k for k, one in enumerate(view.people, start=1) if one.image_of is None]
    return view, [(replace(take, person=k, name=f"{take.name}-person-{k}"), out / f"person-{k}") for k in numbers]


def track_person(
    take: Take, out: Path, choices: Choices, *, view: InView | None, step: Step, tell: Tell, files: dict[str, Path],
) -> TrackedPerson:  # fmt: skip
    """Track one person of a take and write the results; written files are added to `files`.

    An interrupted run (`out/unfinished`) is continued, unless the choices restart it.

    Raises
    ------
    KinefitError
        Tracking or writing fails.
    """
    from kinefit.batch.report import provenance, write_track_report
    from kinefit.batch.viewed import OUTDATED, inputs_entry, is_outdated
    from kinefit.findings import CLOCKS, LABELS, STATURE
    from kinefit.multiview import followed
    from kinefit.takes.track import settings_of, track_take
    from kinefit.tracking import cameras
    from kinefit.tracking.agreement import sentences
    from kinefit.tracking.checkpoints.checkpoint import Checkpoint, key_of
    from kinefit.tracking.takes.floor_level import floor_sentences
    from kinefit.tracking.video import TrackingInterrupted

    notes: list[str] = []
    how: dict[str, Any] = {"smooth": choices.smooth, "contacts": choices.contacts, "lag": choices.lag}
    total, inputs = 0, inputs_entry(take)
    with ExitStack() as work:
        unfinished = work.enter_context(Checkpoint(out / "unfinished", key_of(take, **how), restart=choices.restart))
        for sentence in unfinished.said():
            tell(sentence)
        step("reading", 0, 0)

        def read(what: str, done: int, count: int) -> None:
            step("reading", 1, 1)
            step(what, done, count)

        try:
            motion, seen = track_take(
                take, **how, checkpoint=unfinished, view=view, progress=read
            )
            notes += [*seen.notes, *sentences(motion.provenance["contradictions"])]
            notes += followed.sentences(motion.provenance, asked=take.person is not None)
            notes += cameras.sentences(motion.provenance, settings_of(take).camera_errors)
            notes += [*motion.provenance.get(CLOCKS, ()), *motion.provenance.get(LABELS, ())]
            notes += [*motion.provenance.get(STATURE, ()), *floor_sentences(motion.provenance)]
        except TrackingInterrupted as stopped:
            motion, total = stopped.motion, stopped.total
        motion = replace(motion, provenance=provenance(take, **inputs, **motion.provenance))
        if is_outdated(motion.provenance, take.path):  # changed meanwhile
            notes.append(f"{OUTDATED}.")
        write_results(motion, out, choices.formats, step, files)
        if choices.draws and not total:
            write_overlays(motion, take, seen, out, step, files, skin=choices.overlay_skin)
        if choices.report and not total:
            write_track_report(motion, take, seen, out, step, files, choices.pictures, notes)
        if not total:
            unfinished.remove()
    return TrackedPerson(motion, tuple(notes), total)
