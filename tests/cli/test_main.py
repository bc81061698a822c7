"""The command itself: help, exit codes, what is shown of an error."""

import errno
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

from kinefit import __version__
from kinefit.cli import COMMANDS, main
from kinefit.errors import TakeError


@pytest.fixture
def failing(monkeypatch):
    """Let `kinefit warmup` raise what is given."""

    def install(error):
        from kinefit.cli import _screen

        @click.command()
        @_screen.verbose_option
        def command():
            raise error

        monkeypatch.setattr("kinefit.cli.warmup.warmup", command)

    return install


def test_help_lists_all_commands_and_exit_codes():
    told = CliRunner().invoke(main, ["--help"])
    assert told.exit_code == 0
    assert all(f"\n  {name}" in told.output for name in COMMANDS)
    assert "Exit codes:" in told.output
    assert "130" in told.output


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_has_examples(name):
    told = CliRunner().invoke(main, [name, "--help"])
    assert told.exit_code == 0
    assert "Examples:" in told.output
    assert f"    kinefit {name}" in told.output


def test_help_and_version_import_nothing_heavy():
    code = (
        "import sys; from click.testing import CliRunner; from kinefit.cli import main\n"
        "told = [CliRunner().invoke(main, [c, '--help']).exit_code for c in ('demo', 'track', 'export')]\n"
        "heavy = {'numpy', 'numba', 'cv2', 'av', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'{told} {heavy}' if heavy or any(told) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_version():
    assert CliRunner().invoke(main, ["--version"]).output == f"kinefit, version {__version__}\n"


def test_a_wrong_command_line_is_code_2():
    assert CliRunner().invoke(main, ["dance"]).exit_code == 2
    assert CliRunner().invoke(main, ["track"]).exit_code == 2


def test_an_error_of_the_input_is_one_message_without_traceback(failing):
    failing(TakeError("it is wrong", file="a [b].toml", place="[x] y", remedy="Do this."))
    told = CliRunner().invoke(main, ["warmup"])
    assert told.exit_code == 2
    assert told.stdout == ""
    assert told.stderr == "error: it is wrong\n    at a [b].toml, [x] y\n   try Do this.\n"


def test_verbose_shows_the_traceback_too(failing):
    failing(TakeError("it is wrong"))
    told = CliRunner().invoke(main, ["warmup", "-v"])
    assert told.exit_code == 2
    assert told.stderr.startswith("error: it is wrong\n")
    assert "Traceback" in told.stderr


def test_a_fault_of_kinefit_says_how_to_report_it(failing):
    failing(ZeroDivisionError("by zero"))
    told = CliRunner().invoke(main, ["warmup"])
    assert told.exit_code == 1
    assert "ZeroDivisionError: by zero" in told.stderr
    assert __version__ in told.stderr
    assert "Traceback" not in told.stderr
    assert "Traceback" in CliRunner().invoke(main, ["warmup", "-v"]).stderr


def test_a_full_disk_under_the_cache_is_no_fault_of_kinefit(failing):
    failing(OSError(errno.ENOSPC, "No space left on device"))
    told = CliRunner().invoke(main, ["warmup"])
    assert told.exit_code == 2
    assert "No space left on device" in told.stderr
    assert "KINEFIT_CACHE" in told.stderr


def test_ctrl_c_is_code_130(failing):
    failing(KeyboardInterrupt())
    told = CliRunner().invoke(main, ["warmup"])
    assert told.exit_code == 130
    assert told.stderr == "Stopped. No incomplete files remain.\n"
