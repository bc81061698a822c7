"""What the commands show: results on stdout; progress, notes, errors on stderr. Where results can be written."""

from __future__ import annotations

import _thread
import contextlib
import errno
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import click

from kinefit import __version__
from kinefit.errors import ExportError, KinefitError, choices
from kinefit.readers.plugins import install
from kinefit.studio.serving import TOKEN_VARIABLE
from kinefit.takes.batch.results import Step

if TYPE_CHECKING:
    from rich.console import Console

    from kinefit.findings import Finding

class _Path(click.Path):
    """A file or folder of this computer."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; an address of the network is refused."""
        if isinstance(value, str) and "://" in value:
            self.fail(f"{value!r} is an address, not a file or folder here. Download it, and name what you saved.")
        return super().convert(value, param, ctx)


class _Height(click.ParamType):
    """A stature, as people write it."""

    name = "height"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """[m]."""
        from kinefit._files import stature_of

        try:
            return stature_of(value)
        except KinefitError as error:
            self.fail(str(error), param, ctx)


PATH, HEIGHT = _Path(path_type=Path), _Height()
"""Types of arguments and options that are files or folders; that are statures, in metres or centimetres."""

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES)
"""Errors of the disk, not of kinefit or its user."""

_VERBOSE, _QUIET, _EVENTS = "kinefit.verbose", "kinefit.quiet", "kinefit.events"
_EVENTS_NICE = 10  # lower priority than the program that waits, whose page must answer
_EVENT_INTERVAL_S = 0.1  # between two events of the progress of one piece of work
_STYLES = {"fault": "bold red", "doubt": "yellow", "note": "cyan", "good": "green"}


def _remember(key: str) -> Callable[[click.Context, click.Parameter, bool], bool]:
    """Callback of a flag that the functions of this module ask for."""

    def remember(ctx: click.Context, parameter: click.Parameter, value: bool) -> bool:
        ctx.find_root().meta[key] = value or ctx.find_root().meta.get(key, False)
        return value

    return remember


def gathered(name: str, build: Callable[..., Any] | str, *options: str) -> Callable[[Callable], Callable]:
    """Give a command the values of some options as one argument: what `build` ("module:class", or a function) makes."""

    def decorate(command: Callable) -> Callable:
        @wraps(command)
        def called(*args: Any, **given: Any) -> Any:
            values = {option: given.pop(option) for option in options}
            make = resolve_name(build) if isinstance(build, str) else build
            return command(*args, **given, **{name: make(**values)})

        return called

    return decorate


def is_stated(name: str) -> bool:
    """Whether the command that runs was given this option in so many words."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def verbose_option(command: Callable) -> Callable:
    """Add `-v` to a command, which asks `is_verbose` for it."""
    text = "Show details: residuals of every point in every camera, and the traceback of an error."
    option = click.option("-v", "--verbose", is_flag=True, expose_value=False, callback=_remember(_VERBOSE), help=text)
    return option(command)


def quiet_options(command: Callable) -> Callable:
    """Add `-q` and `--json` (parameter `as_json`) to a command; both let it print nothing else but errors."""
    quiet = click.option(
        "-q", "--quiet", is_flag=True, expose_value=False, callback=_remember(_QUIET), help="Print only errors."
    )
    text = "Print only the result, as one JSON object, and errors."
    return quiet(click.option("--json", "as_json", is_flag=True, callback=_remember(_QUIET), help=text)(command))


def events_option(command: Callable) -> Callable:
    """Add `--events` to the group of all commands."""
    text = (
        "For programs that run kinefit: print progress, notes and errors as JSON lines on the standard error, and stop "
        "as by Ctrl-C at the end of the standard input."
    )

    def remember(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
        if value:
            ctx.find_root().meta[_EVENTS] = True
            with contextlib.suppress(AttributeError, OSError):  # not on Windows
                os.nice(_EVENTS_NICE)
            threading.Thread(target=_interrupt_at_end_of_input, daemon=True).start()

    return click.option("--events", is_flag=True, expose_value=False, callback=remember, help=text)(command)


def _interrupt_at_end_of_input() -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 1024):  # not by sys.stdin, whose lock a thread must not hold when Python ends
            pass
    _thread.interrupt_main()


def _emit(event: str, **content: Any) -> None:
    import json

    print(json.dumps({"event": event, **content}, ensure_ascii=False), file=sys.stderr, flush=True)


def is_verbose() -> bool:
    """Whether the command that runs was given `-v`."""
    return _is_set(_VERBOSE)


def _is_set(key: str) -> bool:
    ctx = click.get_current_context(silent=True)
    return bool(ctx and ctx.find_root().meta.get(key))


def console(*, stderr: bool = False, always: bool = False) -> Console:
    """Where to print; colours only on a terminal. With -q or --json only what is printed `always`."""
    from rich.console import Console

    return Console(stderr=stderr, highlight=False, quiet=_is_set(_QUIET) and not always)


def print_json(result: Mapping[str, Any]) -> None:
    """Print the result of a command that was given --json."""
    import json

    click.echo(json.dumps(result, indent=2, ensure_ascii=False))


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, title: str = "") -> None:
    """Print rows of cells below their heads; with a title in a frame, numbers at the right."""
    from rich.markup import escape
    from rich.table import Table

    framed = {"title": escape(title), "title_justify": "left"}
    table = Table(**(framed if title else {"box": None, "pad_edge": False}))  # type: ignore[arg-type]
    for k, head in enumerate(heads):
        table.add_column(escape(head), justify="right" if title and k else "left", no_wrap=bool(title and not k))
    for row in rows:
        table.add_row(*map(escape, row))
    console().print(table)


def say(text: str = "", *, style: str = "", stderr: bool = False) -> None:
    """Print a line as it stands: never wrapped or taken for markup, as it may hold a path."""
    from rich.text import Text

    console(stderr=stderr).print(Text(text, style=style), soft_wrap=True)


def note(text: str) -> None:
    """Print a line on stderr."""
    if _is_set(_EVENTS):
        _emit("note", text=text)
    else:
        say(text, stderr=True)


def _complain(problem: str, **lines: str) -> None:
    from rich.text import Text

    if _is_set(_EVENTS):
        _emit("error", problem=problem, **lines)
        return
    text = Text.assemble(("error: ", "bold red"), problem)
    for name, line in lines.items():
        if line:
            text.append_text(Text.assemble(f"\n{name:>6} ", (line, "bold" if name == "at" else "")))
    console(stderr=True, always=True).print(text, soft_wrap=True)


def _traceback(error: BaseException) -> None:
    import traceback

    click.echo("".join(traceback.format_exception(error)), err=True)


def tell_error(error: KinefitError) -> None:
    """Say what is wrong with the input, where, and what would work."""
    where = ", ".join(str(part) for part in (error.file, error.place) if part)
    _complain(error.problem, **{"at": where, "try": error.remedy or ""})
    if is_verbose():
        _traceback(error)


def tell_finding(found: Finding) -> None:
    """Print what a check found, its confidence, and what to do."""
    from rich.text import Text

    console().print(
        Text.assemble("\n", (f"{found.severity}: ", _STYLES[found.severity]), found.text), soft_wrap=True
    )
    alike = found.alike if is_verbose() else ""
    for what, text in (("confidence", found.confidence), ("alike", alike), ("try", found.remedy)):
        if text:
            say(f"   {what}: {text}")


def tell_interrupted(text: str) -> None:
    """Say that Ctrl-C came, and what is there."""
    note(f"Stopped. {text or 'No incomplete files remain.'}")


def tell_refused(error: OSError) -> None:
    """Say that the system let something of the cache not be written: results have messages of their own."""
    from kinefit._jit import cache_directory

    cache = f"{cache_directory()} (compiled kernels and downloaded recordings)"
    remedy = "Free some space there, or set KINEFIT_CACHE to another folder."
    _complain(f"a file cannot be written: {error.strerror}", **{"at": str(error.filename or cache), "try": remedy})
    if is_verbose():
        _traceback(error)


def tell_bug(error: Exception) -> None:
    """Say that something went wrong that is not the user's fault."""
    import platform

    versions = f"kinefit {__version__}, Python {platform.python_version()}, {platform.platform()}"
    remedy = "Run the command again with -v for the traceback; send it with the take file to the developers of kinefit"
    if is_verbose():
        _traceback(error)
        remedy = "Send this traceback with the take file to the developers of kinefit"
    _complain(f"an error in kinefit itself: {type(error).__name__}: {error}", **{"at": versions, "try": remedy + "."})


token_option = click.option(
    "--token", envvar=TOKEN_VARIABLE, show_envvar=True, metavar="TEXT",
    help="Secret part of the page's address, 16 to 128 characters.  [default: a new random one each time]",
)
host_option = click.option("--host", default="127.0.0.1", show_default=True, help="0.0.0.0 admits other computers.")
"""For commands that open a server."""

hide_faces_option = click.option(
    "--hide-faces", is_flag=True,
    help="Blur detected faces in all shown video images.  [default: hide_faces of the take]",
)
"""For commands that show what cameras saw."""


@contextmanager
def bars() -> Iterator[Step]:
    """Progress bars on stderr, one for each thing that is done."""
    if _is_set(_EVENTS):
        yield _step_events()
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<14}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=console(stderr=True)) as progress:

        def step(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what, total=total or None)
            progress.update(tasks[what], completed=done, total=total or None)

        yield step


def _step_events() -> Step:
    """Progress as events: a tenth of a second apart for each piece of work, and always its begin and its end."""
    printed: dict[str, float] = {}

    def step(what: str, done: int, total: int) -> None:
        now = time.monotonic()
        if what not in printed or done == total or now - printed[what] > _EVENT_INTERVAL_S:
            printed[what] = now
            _emit("step", what=what, done=done, total=total)

    return step


class CommandGroup(click.Group):
    """A group whose commands are named where none is of the name given."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of a name; an error suggests the nearest one where there is none."""
        names = self.list_commands(ctx)
        if args and args[0] not in names and not args[0].startswith("-"):
            near = get_close_matches(args[0].lower(), names, n=1, cutoff=0.5)
            hint = f" Did you mean '{near[0]}'?" if near else f" There are: {', '.join(names)}."
            raise click.UsageError(f"No such command '{args[0]}'.{hint}", ctx)
        return super().resolve_command(ctx, args)


def no_format(name: str, valid: Iterable[str]) -> str:
    """What to say of a format that there is not."""
    return f"{choices('format', name, valid)}. {install('format')}"


def check_folder(folder: Path, option: str = "--out") -> None:
    """Raise ExportError for a folder that cannot be written, before anything is computed; leave nothing there."""
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    remedy = f"Give another path with {option}."
    if not there.is_dir():
        raise ExportError("a file of that name is in the way", file=there, remedy=remedy)
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        problem = f"this folder cannot be written ({error.strerror})"
        raise ExportError(problem, file=there, remedy=remedy) from error


def check_file(path: Path, option: str = "--out") -> None:
    """Raise ExportError for a file that cannot be written, before anything is computed; leave nothing there."""
    if path.is_dir():
        raise ExportError("a folder of that name is in the way", file=path, remedy=f"Give another file with {option}.")
    check_folder(path.absolute().parent, option)


def check_new(path: Path, overwrite: bool = False, remedy: str = "Add --overwrite, or give another --out.") -> None:
    """Raise ExportError for a file that cannot be written, or that exists."""
    if path.exists() and not overwrite:
        raise ExportError("the file already exists", file=path, remedy=remedy)
    check_file(path)
