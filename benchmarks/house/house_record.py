"""What kinefit can do, a line each: commands and options, keys of a take, formats, kinds of findings, public names.

`python -m benchmarks.house.house_record` writes the record, `tests/capabilities.txt`; a test fails where a line
is lost.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

import click

from benchmarks.figures import ROOT, figure

RECORD = ROOT / "tests" / "capabilities.txt"
LOST = {
    "finding Finding markers": "what readers note on marker files is a finding `files`, as on all other files",
    **{
        f"name {room}": f"the room {path} has it; `kinefit.{room}` still is it"
        for room, path in (
            ("assets", "readers"),
            ("correspondences", "solving"),
            ("evaluation", "simulation"),
            ("rendering", "bodies"),
        )
    },
    "name recipes": "the room is called papers; `kinefit.recipes` still is it",
}
"""{line of the record that is no longer: why}"""


def capabilities() -> set[str]:
    """All that there is now."""
    return {*_commands(), *_take_keys(), *_formats(), *_findings(), *_public_names()}


def lost() -> list[str]:
    """Lines of the record that are no longer, and not listed with a reason."""
    return sorted({*RECORD.read_text("utf-8").splitlines()} - capabilities() - LOST.keys())


def run() -> None:
    """Print the figure."""
    figure("house_capabilities_lost", len(lost()), "of the record", "== 0")


def _commands() -> Iterator[str]:
    from kinefit.cli import main

    def walk(command: click.Command, words: tuple[str, ...]) -> Iterator[str]:
        for parameter in command.params:
            for option in parameter.opts if isinstance(parameter, click.Option) else [parameter.human_readable_name]:
                yield " ".join(("command", *words, option))
            if isinstance(parameter.type, click.Choice):
                yield from (f"command {' '.join(words)} {parameter.opts[0]} {c}" for c in parameter.type.choices)
        if isinstance(command, click.Group):
            for name in command.list_commands(click.Context(command)):
                found = command.get_command(click.Context(command), name)
                yield from walk(found, (*words, name)) if found else ()

    return walk(main, ())


def _take_keys() -> Iterator[str]:
    from kinefit.readers.take.entries import TABLES, keys_of
    from kinefit.readers.take.kinds import BUILT_IN

    for table in (*TABLES, *BUILT_IN):
        yield from (f"take [{table}] {key}" for key in keys_of(table))


def _formats() -> Iterator[str]:
    from kinefit.readers.calibration.read import FORMATS as CALIBRATIONS
    from kinefit.readers.depth.recordings import FORMATS as DEPTHS
    from kinefit.takes.batch.results import FORMATS

    yield from (f"format track {name}" for name in FORMATS.built_in)
    for kind, texts in (("calibration", CALIBRATIONS), ("depth", DEPTHS)):
        yield from (f"format {kind} {one.strip()}" for one in texts.split(","))


def _findings() -> Iterator[str]:
    """Kinds of findings, as far as the sources write them as texts where a finding is made."""
    for path in (ROOT / "src" / "kinefit").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            name = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
            if name.endswith("Finding"):
                texts = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
                place = texts[1:2] if name == "Finding" else texts[:1]
                yield from (f"finding {name} {text}" for text in place)


def _public_names() -> Iterator[str]:
    from kinefit._doors import public_names

    yield from (f"name {name}" for name in [*public_names(), "__version__"])


if __name__ == "__main__":
    RECORD.write_text("\n".join(sorted(capabilities())) + "\n", "utf-8")
