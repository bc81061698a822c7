"""The command line: `kinefit demo`, `init`, `check`, `track` and so on; one file a command.

Heavy imports stand inside the commands, so that help comes at once.
"""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from kinefit import __version__
from kinefit._processes import environment
from kinefit.cli import _screen
from kinefit.errors import KinefitError

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: its threads only wait for each other here

COMMANDS = {
    "demo": "tracking.track", "init": "init", "calibrate": "calibrate", "detect": "detect",
    "check": "checks.check", "track": "tracking.track", "live": "tracking.live", "batch": "tracking.track",
    "markers": "markers.markers", "surface": "surfaces.surface", "body": "body", "view": "view", "app": "view",
    "replay": "motions.simulate", "export": "motions.simulate", "retarget": "motions.simulate",
    "gait": "motions.gait", "movements": "motions.gait",
    "simulate": "motions.simulate", "evaluate": "motions.simulate", "warmup": "warmup",
}  # fmt: skip
"""Commands in the order of use, and their modules."""

_EPILOG = """\b
Examples:
  kinefit demo                          track a person in four sample videos, within a minute
  kinefit init my_take                  a take file for a recording of your own
  kinefit check my_take/take.toml       faults of the recording, and how to correct them
  kinefit track my_take/take.toml       joint angles, tables, overlay videos and a report
  kinefit live my_take/take.toml        track live, and stream poses to avatars and programs
  kinefit batch 'sessions/**/take.toml' track many takes in parallel, with one summary
  kinefit markers --help                optical markers: label them, fit a body to them
  kinefit surface --help                photographs of a textured surface: points, strain
  kinefit export motion.npz --to bvh    write a motion in another format
  kinefit gait motion.npz --report      strides, steps and symmetry of a walk
  kinefit COMMAND --help                options of a command, with examples

\b
Exit codes:
  0    done
  1    an error in kinefit itself; -v shows the traceback
  2    the input or the command line is wrong, or a result cannot be written; the message says what to do
  130  stopped by Ctrl-C; finished results are kept and listed
"""
_WORDS = "kinefit.words"
_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class _Commands(_screen.CommandGroup):
    """Commands that are imported when they are called; errors become messages and exit codes."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Import a command."""
        if name not in COMMANDS:
            return None
        return getattr(import_module(f"kinefit.cli.{COMMANDS[name]}"), name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that is meant, and its words."""
        ctx.meta[_WORDS] = args[1:]
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command."""
        try:
            with warnings.catch_warnings():
                shown = warnings.showwarning

                def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
                    if category is FutureWarning:  # an old key of a take file: no line of code is at fault
                        _screen.say(f"note: {message}")
                    else:
                        shown(message, category, *where)

                warnings.showwarning = show  # type: ignore[assignment]
                return super().invoke(ctx)
        except click.UsageError as error:
            meant = _meant(error, ctx.meta.get(_WORDS, ()))
            if not meant:
                raise
            raise click.UsageError(error.format_message() + meant, error.ctx) from error
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except KinefitError as error:
            _screen.tell_error(error)
            code = error.exit_code
        except KeyboardInterrupt as error:
            _screen.tell_interrupted(str(error))
            code = _screen.INTERRUPTED
        except OSError as error:
            if error.errno not in _screen.REFUSED:
                raise
            _screen.tell_refused(error)
            code = 2
        except Exception as error:
            _screen.tell_bug(error)
            code = 1
        ctx.exit(code)


def _meant(error: click.UsageError, words: Sequence[str]) -> str:
    """What to say of words of a wrong command line that are options but for their dashes: "unit=mm", "unit = mm"."""
    parameters = error.ctx.command.params if error.ctx else []
    names = {option for parameter in parameters for option in parameter.opts if option.startswith("--")}
    found = []
    for k, (name, _, value) in enumerate(word.partition("=") for word in words):
        option = f"--{name.lstrip('-').lower()}"
        if option in names and not name.startswith("--"):
            found.append(f"{option} {value or next((word for word in words[k + 1 :] if word != '='), '')}".strip())
    if found:
        return f" Did you mean {' '.join(found)}?"
    if "unexpected extra argument" in error.message and sum(Path(word).is_file() for word in words) > 1:
        return " Put the files of one recording into a folder of its own, and name the folder."
    if isinstance(error, click.MissingParameter) and isinstance(error.param, click.Option) and error.param.metavar:
        return f" Give {error.param.opts[0]} {error.param.metavar}."
    return ""


@click.group("kinefit", cls=_Commands, epilog=_EPILOG, context_settings=_SETTINGS)
@click.version_option(__version__, "-V", "--version")
@_screen.events_option
def main() -> None:
    """Fit one articulated body to measurements of any sensors."""
    os.environ.update(environment())  # for what libraries start, too
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # names of files may not be UTF-8
