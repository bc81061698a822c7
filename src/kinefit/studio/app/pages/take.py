"""One take: what was found, the person, the check with its remedies, the computation with images as it goes on."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import ui

from kinefit._files import write_text
from kinefit.bodies.rendering.looks import to_hex
from kinefit.errors import KinefitError
from kinefit.findings import Edit, in_words
from kinefit.readers.guess.draft import Note
from kinefit.readers.guess.folder import Guess, guess_take
from kinefit.readers.take.entries import CameraEntry
from kinefit.readers.take.file import Take, find_take, read_take, takes_in
from kinefit.studio.app.desk import Desk
from kinefit.studio.app.folders import NEW, OUTDATED, UNFINISHED, TakeFolder, video_files
from kinefit.studio.app.jobs import DONE, FAILED, PAUSED, RUNNING, WAITING, Job
from kinefit.studio.app.pages import shell as s
from kinefit.studio.app.people import PersonPicture
from kinefit.takes.batch import corrections

_CARDS_REFRESH_S = 3.0  # between two looks at what is detected


def people_cards(desk: Desk, t: s.Texts, take: Path, who: ui.select) -> None:
    """Pictures that appear below once there are several people; a click writes the choice into the take file.

    `who` is the choice by words, which then stands for what the take file says.
    """
    shown: list[tuple[PersonPicture, ...]] = [()]

    def choose(number: int | None) -> None:
        with s.notified():
            corrections.choose_person(take, number)
        who.value = ""
        cards.refresh()

    @ui.refreshable
    def cards() -> None:
        pictures, chosen = shown[0], _chosen(take)
        said = t("people.choose", number=chosen) if chosen else t("people.everybody")
        who.set_options({**_options(who), "": said}, value=who.value)
        if not pictures:
            return
        ui.label(t("people.text"))
        with ui.row().classes("items-end"):
            for picture in pictures:
                number, said = picture.number, t("people.choose", number=picture.number)
                with ui.column().classes("gap-1 items-center"):
                    source = s.link("/image/person", path=take, number=number)
                    image = ui.image(source).classes("w-28 h-40 cursor-pointer").props("fit=contain")
                    image.props["alt"] = said
                    image.on("click", lambda n=number: choose(n))
                    _button(said, number == chosen, lambda n=number: choose(n))
            _button(t("people.everybody"), not chosen, lambda: choose(None))
        if chosen:
            ui.label(t("people.chosen", number=chosen)).classes("text-sm")

    async def look() -> None:
        found = await s.in_thread(desk.people.of, take, hide_faces=bool(desk.hide_faces))
        if found is not shown[0] and (found or shown[0]):
            shown[0] = found
            cards.refresh()

    cards()
    ui.timer(_CARDS_REFRESH_S, look)


def _options(who: ui.select) -> dict[Any, Any]:
    assert isinstance(who.options, dict)
    return who.options


def _chosen(take: Path) -> int | None:
    """Number of the person that the take file names; None for everybody, and where words say who."""
    try:
        person = read_take(take).person
    except KinefitError:
        return None
    return person if isinstance(person, int) else None


def _button(text: str, is_chosen: bool, on_click: Any) -> None:
    ui.button(text, icon="check" if is_chosen else "person", on_click=on_click).props("" if is_chosen else "outline")


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
        source = s.link("/image/raw", path=camera.video, share=f"{progress.share:.4f}", **_span(take, camera))
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


_REFRESH_S = 0.5  # between two looks at the job
_MAX_NOTES = 8  # of a job that are shown
_ICONS = {"fault": "error", "doubt": "help", "note": "info", "good": "check_circle"}
_CONFIDENCE = {"sure": "good", "likely": "note", "guess": "doubt", "open": "fault"}
_REMEDIES = {"bias": ("refine",), "lens": ("refine_focal",), "time": ("refine_time",)}
"""Kinds of findings for which `kinefit check --refine` helps: keys of texts and of `_REFINE`."""
_REFINE = {
    "refine": ("--refine",), "refine_time": ("--refine", "--time-offsets"), "refine_focal": ("--refine", "--focal"),
}  # fmt: skip


async def take_page(desk: Desk, path: str) -> None:
    """Build the page of a take file, or of a folder, whose take file is written if the user asked for it."""
    t, at, guess = s.texts(), Path(path), None
    is_asked_for = at in desk.chosen
    desk.chosen.discard(at)
    with s.shell(desk, t, s.short(at, desk.root)):
        first_images(at)
        if at.is_dir() and not takes_in(at):
            guess = await s.loaded(t, t("take.reading"), guess_take, at)
            if guess is None:
                return
            if not is_asked_for:
                ui.label(t("take.no_file", folder=at))
                ui.button(t("home.use"), icon="folder_open", on_click=lambda: use_folder(desk, at))
                return
        opened = await s.loaded(t, t("take.reading"), opened_take, at, guess)
        if opened is not None:
            file, take, notes = opened
            desk.files.folders.add(file.parent)
            _TakePage(desk, t, TakeFolder(file), take, notes)


def use_folder(desk: Desk, folder: Path) -> None:
    """Open a folder, as the user asked for it: its first take file is written then."""
    desk.chosen.add(folder)
    ui.navigate.to(s.link("/take", path=folder))


def first_images(path: Path) -> None:
    """The first image of each video, before anything else is read."""
    videos = video_files(path if path.is_dir() else path.parent)
    with ui.row().classes("w-full"):
        for video in videos:
            with ui.column().classes("gap-0"):
                image = ui.image(s.link("/image/first", path=video)).classes("w-48 min-h-[6rem]")
                image.props["alt"] = video.stem
                ui.label(video.name).classes("text-sm")


def opened_take(path: Path, guess: Guess | None) -> tuple[Path, Take, tuple[Note, ...]]:
    """The take file at a path, what it says, and what was guessed for it; a guess for a folder is written first.

    Raises
    ------
    KinefitError
        Nothing is there, or nothing of which a take can be made; a take file that is invalid.
    """
    if guess is not None:
        write_text(path / "take.toml", guess.text)
    file = find_take(path).absolute()
    return file, read_take(file), guess.notes if guess is not None else ()


class _TakePage:
    """The parts of the page below the images."""

    def __init__(self, desk: Desk, t: s.Texts, folder: TakeFolder, take: Take, notes: tuple[Note, ...]) -> None:
        self._desk, self._t, self._folder, self._take, self._notes = desk, t, folder, take, notes
        self._shown: tuple[object, ...] = ()
        with ui.expansion(t("take.found_title"), value=bool(notes)).classes("w-full"):
            self._found()
        with s.card(t("take.person_title")):
            self._person()
        with ui.row():
            ui.button(t("take.track"), icon="play_arrow", on_click=self._track)
            ui.button(t("take.check"), icon="fact_check", on_click=self._check).props("outline")
        self._work()
        self._findings()
        ui.timer(_REFRESH_S, self._look)

    def _found(self) -> None:
        t = self._t
        ui.label(t("take.file", file=self._folder.file)).classes("text-sm break-all")
        for note in self._notes:
            with ui.row().classes("items-center no-wrap"):
                severity = _CONFIDENCE[note.sure]
                ui.icon(_ICONS[severity]).style(f"color: {to_hex(s.COLOURS[severity])}").tooltip(t(f"take.{note.sure}"))
                ui.label(f"{note.about}: {note.text}").classes("text-sm")

    def _person(self) -> None:
        t = self._t
        with ui.row().classes("items-end"):
            height = ui.input(t("take.height"), value=f"{self._take.height or ''}", placeholder="1.75, 175 cm")
            height.classes("w-64").tooltip(t("take.height_text")).on("blur", lambda: self._set_height(height.value))
            who = {"": t("take.everybody"), "first": t("take.first"), "moving": t("take.moving")}
            who |= {"largest": t("take.largest")}
            chosen = self._take.person if self._take.person in who else ""
            self._who = ui.select(who, label=t("take.who"), value=chosen).classes("w-64")
            self._who.on_value_change(lambda: self._choose(self._who.value))
            qualities = {"best": t("take.best"), "balanced": t("take.balanced")}
            self._quality = ui.select(qualities, label=t("take.quality"), value="best").classes("w-40")
        people_cards(self._desk, t, self._folder.file, self._who)

    def _set_height(self, height: str) -> None:
        if height.strip() != f"{self._take.height or ''}":
            self._edit(lambda: corrections.set_height(self._folder.file, height.strip()), self._t("take.height_saved"))

    def _choose(self, who: str) -> None:
        """Write who is meant into the take file; a number that was chosen by an image stays."""
        if who or isinstance(read_take(self._folder.file).person, str):
            self._edit(lambda: corrections.choose_person(self._folder.file, who or None), self._t("take.who_saved"))

    def _write(self, found: dict[str, Any]) -> None:
        """Write the edits of a finding into the take, and check again."""
        edits = [Edit(**edit) for edit in found["edits"]]
        said = self._t("take.written", edits=in_words(edits, " in "))
        self._edit(lambda: corrections.write_edits(self._folder.file, edits), said)
        self._check()

    def _edit(self, edit: Callable[[], object], said: str) -> None:
        with s.notified():
            edit()
            self._take = read_take(self._folder.file)
            ui.notify(said, type="positive")

    def _detect(self) -> None:
        """Ask for the faster detection, where it was chosen and nothing is detected yet."""
        if self._quality.value == "balanced" and self._folder.state == NEW:
            self._desk.start(self._folder.file, "detect", str(self._folder.file), "--quality", "balanced")

    def _track(self, *options: str) -> None:
        self._detect()
        self._desk.start(self._folder.file, "track", str(self._folder.file), "--json", *options)

    def _check(self, *options: str) -> None:
        self._detect()
        self._desk.start(self._folder.file, "check", str(self._folder.file), "--json", *options)

    def _look(self) -> None:
        """Show what changed since the last look."""
        if not self._folder.file.exists():
            state: tuple[object, ...] = ("gone",)
        else:
            jobs = [job for job in self._desk.jobs.jobs if job.take == self._folder.file]
            state = (self._folder.state, *((job.kind, job.state, len(job.notes)) for job in jobs))
        if state != self._shown:
            self._shown = state
            self._work.refresh()
            self._findings.refresh()
        else:
            for update in self._updates:
                update()

    @ui.refreshable_method
    def _work(self) -> None:
        """Jobs of the take with their progress, and what they made."""
        t, file = self._t, self._folder.file
        self._updates: list[Callable[[], None]] = []
        if not file.exists():
            ui.label(t("take.no_take", file=file)).props('role="alert"')
            return
        jobs = [job for job in self._desk.jobs.jobs if job.take == file]
        for job in jobs:
            if job.state != DONE:
                with s.card(f"{t('take.progress_title')}: {t(f'state.{job.state}')}"):
                    self._job(job)
        open_jobs = any(job.is_open for job in jobs)
        if not open_jobs and self._folder.state == UNFINISHED and not any(job.state == PAUSED for job in jobs):
            with s.card(t("state.unfinished")):
                ui.label(t("take.paused_text"))
                self._resume_buttons()
        if self._folder.people and not open_jobs:
            self._results()

    def _job(self, job: Job) -> None:
        t = self._t
        if job.state == WAITING:
            before = next((other for other in self._desk.jobs.jobs if other.state == RUNNING), None)
            if before is not None and before is not job:
                ui.label(t("take.waiting_for", name=s.short(before.take, self._desk.root)))
        steps = ui.column().classes("w-full gap-1")
        bars: dict[str, tuple[Any, Any]] = {}

        def update() -> None:
            for what, progress in job.steps.items():
                if what not in bars:
                    with steps, ui.row().classes("w-full items-center no-wrap"):
                        ui.label(self._step_name(what)).classes("w-64 text-sm")
                        bar = ui.linear_progress(0.0, show_value=False).classes("flex-1")
                        bars[what] = bar, ui.label().classes("w-40 text-sm")
                bar, left = bars[what]
                bar.value = round(progress.share, 3)
                seconds = progress.seconds_left
                left.text = "" if seconds is None or progress.share >= 1.0 else _time_left(t, seconds)

        update()
        self._updates += [update, coming_images(self._take, job)]
        for note in job.notes[-_MAX_NOTES:]:
            ui.label(note).classes("text-sm text-grey-8")
        if job.state == FAILED and job.error is not None:
            s.show_error(t, job.error)
        if job.is_open:
            ui.button(t("take.pause"), icon="pause", on_click=job.pause).props("outline")
        elif job.state == PAUSED:
            ui.label(t("take.paused_text"))
            if job.kind == "track":
                self._resume_buttons()

    def _resume_buttons(self) -> None:
        with ui.row():
            ui.button(self._t("take.resume"), icon="play_arrow", on_click=lambda: self._track())
            restart = ui.button(self._t("take.restart"), icon="restart_alt", on_click=lambda: self._track("--restart"))
            restart.props("flat")

    def _step_name(self, what: str) -> str:
        kind, _, name = what.partition(" ")
        if any(camera.name == what for camera in self._take.cameras):
            kind, name = "detecting", what
        return self._t.get(f"step.{what}") or (self._t.get(f"step.{kind}") or what).format(name=name)

    def _results(self) -> None:
        t, people = self._t, self._folder.people
        if self._folder.state == OUTDATED:
            ui.label(t("take.outdated")).props('role="alert"')
        with ui.row():
            for k, folder in enumerate(people, start=1):
                said = t("take.result") if len(people) == 1 else t("take.result_of", number=k)
                to = s.link("/result", path=self._folder.file, folder=folder)
                ui.button(said, icon="accessibility_new", on_click=lambda to=to: ui.navigate.to(to))
                if (folder / "report.html").is_file():
                    ui.link(t("take.report"), s.link("/file", path=folder / "report.html"), new_tab=True)

    @ui.refreshable_method
    def _findings(self) -> None:
        """What the last check found, each with the buttons that mend it."""
        job = self._desk.jobs.of(self._folder.file, "check")
        if job is None or job.state != DONE or job.result is None:
            return
        t = self._t
        with s.card(t("take.check_title")):
            shown = [found for found in job.result["findings"] if found["severity"] != "good"]
            if not shown:
                ui.label(t("take.check_none"))
            for found in shown:
                with ui.row().classes("items-start no-wrap"):
                    colour = to_hex(s.COLOURS[found["severity"]])
                    ui.icon(_ICONS[found["severity"]], size="sm").style(f"color: {colour}")
                    with ui.column().classes("gap-0"):
                        ui.label(found["text"])
                        ui.label(found["remedy"]).classes("text-sm text-grey-8")
                        with ui.row():
                            for remedy in _REMEDIES.get(found["kind"], ()) if found["severity"] != "note" else ():
                                ui.button(t(f"take.{remedy}"), on_click=lambda r=remedy: self._check(*_REFINE[r]))
                            if found["edits"]:
                                ui.button(t("take.write"), on_click=lambda f=found: self._write(f)).props("outline")
            if job.result["refined"]:
                with ui.row().classes("items-center"):
                    ui.label(t("take.refined", file=job.result["refined"])).classes("break-all")
                    to = s.link("/take", path=job.result["refined"])
                    ui.button(t("take.use_refined"), on_click=lambda: ui.navigate.to(to))
            page = s.link("/file", path=self._folder.check_page)
            s.page_frame(f"{self._desk.prefix}{page}", t("take.check_page")).classes("w-full h-[36rem] border")
            ui.link(t("take.check_page"), page, new_tab=True)


def _time_left(t: s.Texts, seconds: float) -> str:
    if seconds < 90:
        return t("take.left_seconds", seconds=max(1, round(seconds)))
    return t("take.left", minutes=round(seconds / 60))
