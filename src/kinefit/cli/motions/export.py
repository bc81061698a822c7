"""`kinefit export`: a motion file in another format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click

from kinefit._files import LENGTHS, worth
from kinefit.batch import results
from kinefit.cli import _results, _screen
from kinefit.errors import spelled


class Freedom(NamedTuple):
    """What may be chosen of a format, the default first; `why` there is no more choice."""

    unit: tuple[str, ...] = ()
    up: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    rest: tuple[str, ...] = ()
    why: str = ""


_UPS = ("x", "y", "z", "-x", "-y", "-z")
_Y_UPS, _Z_UPS = (("y", "x", "z", *_UPS[3:]), ("z", "x", "y", *_UPS[3:]))
_NAMES = ("kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh")
_RESTS = ("body", "t")
_OF_BVH = ("bvh", *_NAMES[:-1])
_OF_HANIM = ("hanim", *(name for name in _NAMES if name != "hanim"))
_OPENSIM = "OpenSim files are in metres, y up, with the names of the body's coordinates"

FREEDOM = {
    "csv": Freedom(("m", "cm", "mm"), _UPS, _NAMES),
    "parquet": Freedom(("m", "cm", "mm"), _UPS, _NAMES),
    "bvh": Freedom(("cm", "m", "mm"), _Y_UPS, _OF_BVH, _RESTS),
    "glb": Freedom((), (), _NAMES, _RESTS, "GLB is in metres and y up by its specification"),
    "usd": Freedom(("m", "cm", "mm"), ("y", "z"), _NAMES, _RESTS, "USD supports only y and z up"),
    "c3d": Freedom(("mm", "cm", "m"), _UPS, _NAMES),
    "trc": Freedom(("m", "cm", "mm"), _Y_UPS, (), (), "TRC has landmarks, with their H-Anim names"),
    "x3d": Freedom((), (), _OF_HANIM, _RESTS, "X3D is in metres and y up by its standard"),
    "nwb": Freedom((), _UPS, _NAMES, (), "kinefit writes NWB in metres"),
    "mcap": Freedom((), _Z_UPS, _NAMES, (), "ROS is in metres"),
    "rrd": Freedom((), _UPS, _NAMES, (), "kinefit writes RRD in metres"),
    "jsonl": Freedom((), _UPS, (), (), "JSON lines are in metres, with the names of the body's segments"),
    "mot": Freedom(why=_OPENSIM),
    "osim": Freedom(why=_OPENSIM),
}
"""Choices of every format."""

KEYS = ("unit", "up", "names", "rest")

_ENDINGS = {"csv": "-tables", "parquet": "-tables", "usd": ".usdc"}

_EXAMPLES = """\b
Examples:
  kinefit export take-kinefit/motion.npz --to bvh --unit m            upright and of the right size in Blender
  kinefit export motion.npz --to glb --names mixamo                   retargets by name in Blender, Unity, Unreal
  kinefit export motion.npz --to usd --up z --out walk.usda
  kinefit export motion.npz --to trc --out walk.trc --unit mm
  kinefit export motion.npz --to parquet --out tables
  kinefit export motion.npz --retarget character.glb                  the motion on another character's mesh

\b
Values of each format, default first (csv, parquet, c3d, nwb, rrd, jsonl keep the vertical axis; --names mixamo has
rest pose t):
""" + "".join(
    f"  {format:<8} "
    + "; ".join(f"--{key} {' '.join(getattr(free, key))}" for key in KEYS if getattr(free, key))
    + ("none" if not any(getattr(free, key) for key in KEYS) else "")
    + "\n"
    for format, free in FREEDOM.items()
)


def _format(ctx: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """A format; where there is none of the name, what would do instead."""
    if value is None:
        return None
    format = spelled(value, FREEDOM)
    if format not in FREEDOM:
        raise click.BadParameter(_results.no_format(value, FREEDOM))
    return format


@click.command(short_help="Write a motion file in another format.", epilog=_EXAMPLES)
@click.argument("motion", type=click.Path(path_type=Path))
@click.option(
    "--to", "format", callback=_format, metavar=f"[{'|'.join(FREEDOM)}]",
    help="Format to write; csv and parquet give a folder of tables. Required without --retarget.",
)
@click.option(
    "--retarget", "character", type=click.Path(path_type=Path), metavar="CHARACTER",
    help="Write the motion on the skeleton and mesh of a GLB, VRM, glTF or BVH file.",
)
@click.option(
    "--names-table", "table", type=click.Path(path_type=Path), metavar="TOML",
    help="With --retarget: lines such as thigh_l = \"JointName\", for joints that are not recognised by name.",
)
@click.option("-o", "--out", type=click.Path(path_type=Path), help="File or folder.  [default: next to MOTION]")
@click.option("--unit", metavar="UNIT", help="Unit of length: m, cm or mm.")
@click.option("--up", metavar="AXIS", help="Vertical axis: x, y, z, -x, -y or -z.")
@click.option("--names", metavar="NAMES", help="Names of joints: kinefit, mixamo, cmu, opensim, hanim or bvh.")
@click.option("--rest", metavar="POSE", help="Rest pose: body (arms hanging, facing x) or t (a T facing z).")
@click.option("--cylinders", is_flag=True, help="GLB and USD: write the body's cylinders instead of a skin.")
@_screen.verbose_option
def export(
    motion: Path, format: str | None, character: Path | None, table: Path | None, out: Path | None, cylinders: bool,
    **choices: str | None,
) -> None:
    """Write a motion file of `kinefit track` in another format, or on another character."""
    if character is not None:
        given = {"to": format, **choices, "cylinders": cylinders or None}
        others = [key for key, value in given.items() if value is not None]
        return _retarget(motion, character, table, out, others)
    if table is not None:
        raise click.UsageError("--names-table needs --retarget CHARACTER, whose joints it names.")
    if format is None:
        problem = f"Missing option '--to' (or --retarget CHARACTER). Give --to [{'|'.join(FREEDOM)}]."
        raise click.UsageError(problem)
    if cylinders and format not in ("glb", "usd"):
        raise click.UsageError(f"--cylinders does not apply to {format}: only glb and usd contain a mesh of the body.")
    options = {
        key: _choice(format, key, _meant(key, value, getattr(FREEDOM[format], key)))
        for key, value in choices.items() if value is not None
    }  # fmt: skip
    from kinefit.readers.motion import find_motion, read_motion

    motion = find_motion(motion)
    out = out or motion.with_name(f"{motion.stem}{_ENDINGS.get(format, '.' + format)}")
    (_results.check_folder if format in ("csv", "parquet") else _results.check_file)(out)
    recorded = read_motion(motion)
    more = {"cylinders": True} if cylinders else {}
    results.write_format(recorded, format, out, **options, **more)
    stated = ", ".join([*(f"{key} {value}" for key, value in options.items()), *["cylinders"] * cylinders])
    _screen.say(f"{out}: {results.DESCRIPTIONS[format]}, {len(recorded)} frames{', ' + stated if stated else ''}")


def _meant(key: str, value: str, valid: Sequence[str]) -> str:
    """A value as it is called here: "MM" and "millimetres" are mm, "OpenSim" is opensim, "Z" is z."""
    if key == "up":
        return value.strip().lower()
    metres = worth(value, LENGTHS) if key == "unit" else None
    return next((unit for unit in valid if metres == LENGTHS.get(unit)), value) if metres else spelled(value, valid)


def _retarget(motion: Path, character: Path, table: Path | None, out: Path | None, others: list[str]) -> None:
    """Write a motion on a character, in its format."""
    if others:
        raise click.UsageError(f"--{others[0]} does not apply with --retarget: the character's file determines it.")
    from kinefit.exporters import write_character
    from kinefit.exporters.skeletons.retarget import in_words
    from kinefit.readers.motion import find_motion, read_motion
    from kinefit.readers.skeletons.characters import KINDS, read_names

    motion = find_motion(motion)
    ending = KINDS.get(character.suffix.lower(), character.suffix)
    out = out or motion.with_name(f"{motion.stem}-{character.stem}.{ending}")
    _results.check_file(out)
    recorded = read_motion(motion)
    found = write_character(recorded, character, out, names=read_names(table) if table else None)
    _screen.say(f"{out}: {len(recorded)} frames on {len(found.segments)} joints of {character.name}")
    if found.lacking:
        _screen.note(f"{character.name} has no bones for moving fingers of the motion. {in_words(found.lacking)}.")


def _choice(format: str, key: str, value: str) -> str:
    """An option, refused where the format has no freedom for it, with why and what there is."""
    valid = getattr(FREEDOM[format], key)
    if value in valid:
        return value
    why = f"{FREEDOM[format].why}. " if FREEDOM[format].why and not (valid and key == "unit") else ""
    if valid:
        raise click.UsageError(f"{why}--{key} {value} is not possible for {format}. Give one of: {', '.join(valid)}.")
    others = [name for name, free in FREEDOM.items() if getattr(free, key)]
    raise click.UsageError(f"{why}--{key} does not apply to {format}, only to {', '.join(others)}.")
