"""Commands on motions: `kinefit simulate`, `export`, `retarget`, `replay`, `evaluate`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.errors import command, spelled
from kinefit.takes.batch.results import FORMATS, OPTIONS, description, write_format

if TYPE_CHECKING:
    from kinefit.bodies.motion import Motion
    from kinefit.observations.recordings import SkeletonMotion
    from kinefit.simulation.evaluation.voodoo import Summary

NAMES = tuple(name for name in FORMATS.names() if name != "motion")
"""Formats into which a motion file can be written."""


def _choices(format: str) -> str:
    """The values of a format's options, or the plug-in that has them."""
    if FORMATS.plugins(format):
        return description(format)
    stated = {key: getattr(FORMATS.get(format), key) for key in OPTIONS}
    return "; ".join(f"--{key} {' '.join(values)}" for key, values in stated.items() if values) or "none"


_EXAMPLES = """\b
Examples:
  kinefit export take-kinefit/motion.npz --to bvh --unit m            upright and of the right size in Blender
  kinefit export motion.npz --to fbx --names unreal                   for Unreal, with the bones of its mannequin
  kinefit export motion.npz --to usd --up z --out walk.usda
  kinefit export motion.npz --to trc --out walk.trc --unit mm
  kinefit export motion.npz --to parquet --out tables
  kinefit export motion.npz --retarget character.glb                  the motion on another character's mesh

\b
Values of each format, default first (csv, parquet, c3d, nwb, rrd, jsonl keep the vertical axis; --names mixamo, vrm,
unity and unreal have rest pose t):
""" + "".join(f"  {format:<8} {_choices(format)}\n" for format in NAMES)


def _format(ctx: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """A format; where there is none of the name, what would do instead."""
    if value is None:
        return None
    format = spelled(value, NAMES)
    if format not in NAMES:
        raise click.BadParameter(_screen.no_format(value, NAMES))
    return format


@click.command(short_help="Write a motion file in another format.", epilog=_EXAMPLES)
@click.argument("motion", type=_screen.PATH)
@click.option(
    "--to", "format", callback=_format, metavar=f"[{'|'.join(NAMES)}]",
    help="Format to write; csv and parquet give a folder of tables. Required without --retarget.",
)
@click.option(
    "--retarget", "character", type=_screen.PATH, metavar="CHARACTER",
    help="Write the motion on the skeleton and mesh of a GLB, VRM, glTF or BVH file.",
)
@click.option(
    "--names-table", "table", type=_screen.PATH, metavar="TOML",
    help="With --retarget: lines such as thigh_l = \"JointName\", for joints that are not recognised by name.",
)
@click.option("-o", "--out", type=_screen.PATH, help="File or folder.  [default: next to MOTION]")
@click.option("--unit", metavar="UNIT", help="Unit of length: m, cm or mm.")
@click.option("--up", metavar="AXIS", help="Vertical axis: x, y, z, -x, -y or -z.")
@click.option("--names", metavar="NAMES", help=f"Names of joints: {', '.join(FORMATS.get('glb').names)}.")
@click.option("--rest", metavar="POSE", help="Rest pose: body (arms hanging, facing x) or t (a T facing z).")
@click.option("--cylinders", is_flag=True, help="FBX, GLB and USD: write the body's cylinders instead of a skin.")
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
        problem = f"Missing option '--to' (or --retarget CHARACTER). Give --to [{'|'.join(NAMES)}]."
        raise click.UsageError(problem)
    if cylinders and format not in ("fbx", "glb", "usd"):
        raise click.UsageError(f"--cylinders does not apply to {format}: only fbx, glb and usd contain a mesh.")
    chosen = FORMATS.get(format)
    options = {
        key: _choice(format, key, _meant(key, value, getattr(chosen, key)))
        for key, value in choices.items() if value is not None
    }  # fmt: skip
    from kinefit.readers.motion import find_motion, read_motion

    motion = find_motion(motion)
    out = out or motion.with_name(f"{motion.stem}{chosen.ending or f'-{chosen.file}'}")
    (_screen.check_file if chosen.ending else _screen.check_folder)(out)
    recorded = read_motion(motion)
    more = {"cylinders": True} if cylinders else {}
    write_format(recorded, format, out, **options, **more)
    stated = ", ".join([*(f"{key} {value}" for key, value in options.items()), *["cylinders"] * cylinders])
    _screen.say(f"{out}: {description(format)}, {len(recorded)} frames{', ' + stated if stated else ''}")


def _meant(key: str, value: str, valid: Sequence[str]) -> str:
    """A value as it is called here: "MM" and "millimetres" are mm, "OpenSim" is opensim, "Z" is z."""
    if key == "up":
        return value.strip().lower()
    from kinefit._files import LENGTHS, worth

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
    _screen.check_file(out)
    recorded = read_motion(motion)
    found = write_character(recorded, character, out, names=read_names(table) if table else None)
    _screen.say(f"{out}: {len(recorded)} frames on {len(found.segments)} joints of {character.name}")
    if found.lacking:
        _screen.note(f"{character.name} has no bones for moving fingers of the motion. {in_words(found.lacking)}.")


def _choice(format: str, key: str, value: str) -> str:
    """An option, refused where the format has no freedom for it, with why and what there is."""
    chosen = FORMATS.get(format)
    valid = getattr(chosen, key)
    if value in valid:
        return value
    why = f"{chosen.why}. " if chosen.why and (not valid or (key == "up" and "x" not in valid)) else ""
    if valid:
        raise click.UsageError(f"{why}--{key} {value} is not possible for {format}. Give one of: {', '.join(valid)}.")
    others = [name for name in FORMATS.built_in if getattr(FORMATS.get(name), key)]
    raise click.UsageError(f"{why}--{key} does not apply to {format}, only to {', '.join(others)}.")


_SENSORS = ("tof", "kinect", "stereo", "colour", "keypoints")
def _frames(ctx: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int | None] | None:
    if value is None:
        return None
    first, colon, last = value.partition(":")
    try:
        return int(first or 0), int(last) if last else None if colon else int(first) + 1
    except ValueError:
        raise click.BadParameter("give FIRST:LAST, without the frame LAST.") from None


def _place(azimuth: float, no_room: bool, **others: Any) -> dict[str, Any]:
    """Where the sensors stand, and the room and the seed, as `write_recording` has them."""
    return {"azimuth": math.radians(azimuth), "room": not no_room, **others}


@click.command(short_help="Simulate depth, stereo and colour cameras for a motion.", epilog="""\b
Examples:
  kinefit simulate walk.bvh -o walk --sensor kinect
  kinefit simulate motion.npz -o seen --sensor tof --sensor stereo --azimuth 30
  kinefit simulate 02_01.amc --asf 02.asf -o seen --frames 100:200 --body humanoid10
  kinefit track seen/take.toml
""")  # fmt: skip
@click.argument("motion", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, required=True, help="Folder for the take.")
@click.option(
    "--sensor", "sensors", type=click.Choice(_SENSORS), multiple=True, default=("kinect",), show_default=True,
    help="Sensor to simulate; repeat for several.",
)  # fmt: skip
@click.option("--body", help="Body of the catalogue, or a file.  [default: the motion's, or humanoid]")
@click.option("--asf", type=_screen.PATH, help="Skeleton (.asf) of an .amc file.")
@click.option("--rate", type=click.FloatRange(min=0, min_open=True), help="Frames per second.  [default: at most 30]")
@click.option("--frames", callback=_frames, help="FIRST:LAST at this rate, without LAST.  [default: all]")
@click.option("--distance", type=click.FloatRange(0.1, 50), help="[m] to the sensors.  [default: nearest full view]")
@click.option("--azimuth", type=float, default=0.0, show_default=True, help="[deg] 90: at the person's left.")
@click.option("--height", type=float, default=1.2, show_default=True, help="[m] of the sensors above the floor.")
@click.option("--no-room", is_flag=True, help="Leave out floor, walls and table.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all noise.")
@_screen.verbose_option
@_screen.gathered("place", _place, "distance", "azimuth", "height", "no_room", "seed")
def simulate(
    motion: Path, out: Path, sensors: tuple[str, ...], body: str | None, asf: Path | None, rate: float | None,
    frames: tuple[int, int | None] | None, place: dict[str, Any],
) -> None:  # fmt: skip
    """Simulate the sensors in front of a person who performs MOTION (.npz of kinefit, .bvh or .amc).

    The folder gets a take for kinefit track, and the true motion in truth/.
    """
    from kinefit.exporters import write_csv, write_motion
    from kinefit.simulation import cut, write_recording

    _screen.check_folder(out)
    with _screen.bars() as step:
        known = _known(motion, body, asf, rate, step)
        known = cut(known, *frames) if frames else known

        def truth(folder: Path) -> None:
            write_motion(known, folder / "truth" / "motion.npz")
            write_csv(known, folder / "truth")

        take = write_recording(
            known, out, sensors, **place, step=step, beside=truth,
            body=Path(body).resolve() if body and body.endswith(".toml") else None,
        )  # fmt: skip
    _screen.say(f"{take}: {len(known)} frames at {known.rate:g} Hz of the body {known.body.name}")
    _screen.say(f"{out / 'truth'}: the true motion (motion.npz, joints.csv and more)")
    _screen.say(f"Next:\n  {command('track', take)}")


def _known(path: Path, body: str | None, asf: Path | None, rate: float | None, step: _screen.Step) -> Motion:
    """The motion on the body and at the rate asked for."""
    from kinefit.bodies import load_body
    from kinefit.readers.motion import read_motion
    from kinefit.simulation import on_body, resampled, retarget

    check_recording(path, asf, (".npz", ".bvh", ".amc"), "MOTION")
    chosen = load_body(body) if body else None
    if path.suffix.lower() == ".npz":
        known = read_motion(path)
        known = resampled(known, rate or 30.0) if rate or known.rate > 30.0 else known
    else:
        skeleton = read_skeleton(path, asf)
        step("retargeting", 0, 0)
        known = retarget(skeleton, rate=rate or min(skeleton.rate, 30.0))
        step("retargeting", len(known), len(known))
    if chosen is not None and chosen.name != known.body.name:
        known = on_body(known, chosen)
    return known


def check_recording(path: Path, asf: Path | None, endings: Sequence[str], name: str) -> None:
    """Raise click's errors for a recorded motion of another ending, or an .amc without its skeleton."""
    if path.suffix.lower() not in endings:
        known = f"{', '.join(endings[:-1])} or {endings[-1]}"
        raise click.BadParameter(f"'{path.name}' is not a {known} file.", param_hint=name)
    if (asf is not None) != (path.suffix.lower() == ".amc"):
        raise click.UsageError("An .amc file needs its skeleton: give --asf FILE. With other files, leave out --asf.")


def read_skeleton(path: Path, asf: Path | None, **options: Any) -> SkeletonMotion:
    """The skeleton and motion of a .bvh file, or of an .amc file with its .asf."""
    from kinefit.readers.skeletons.acclaim import read_amc
    from kinefit.readers.skeletons.bvh import read_bvh

    return read_amc(asf, path, **options) if asf else read_bvh(path, **options)


_NAMES = {"3d": "3D (depth)", "2d": "2D (face, hands)", "fusion": "fusion"}


@click.command(short_help="Grade a tracker on simulated sequences of known motion.", epilog="""\b
Examples:
  kinefit evaluate                                 the fusion tracker on all 100 sequences
  kinefit evaluate --method voodoo                 the published method, with three improvements
  kinefit evaluate --sensor kinect --count 10      ten sequences, each movement and each person once
""")  # fmt: skip
@click.option("--suite", type=click.Choice(["voodoo"]), default="voodoo", show_default=True,
              help="Ten movements by ten people: depth images, and face and hands in 2D.")  # fmt: skip
@click.option("--count", type=click.IntRange(1, 100), default=100, show_default=True, help="Number of sequences.")
@click.option("--method", type=click.Choice(["fusion", "live", "voodoo"]), default="fusion", show_default=True,
              help="The fusion tracker, smoothed or live; or VooDoo with three improvements.")  # fmt: skip
@click.option("--sensor", type=click.Choice(["tof", "kinect"]), default="tof", show_default=True)
@click.option("--start", type=click.Choice(["truth", "found"]), default="truth", show_default=True,
              help="First pose: the true one, or estimated from the first depth image.")  # fmt: skip
@click.option("--rate", type=click.FloatRange(1, 120), default=10.0, show_default=True, help="Frames per second.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of people and sensor noise.")
@_screen.verbose_option
def evaluate(
    suite: str, count: int, method: str, sensor: str, start: str, rate: float, seed: int
) -> None:  # fmt: skip
    """Track simulated sequences of known motion and grade each 0 (lost), 1 (acceptable) or 2 (good).

    Grade 2: the mean joint error is at most 60 mm, and no joint is off by more than 150 mm in over 5 % of the frames.
    Grade 0: a joint is off by more than 250 mm at the end, or in most of the frames.
    """
    from kinefit.simulation.evaluation.sequences import sequences
    from kinefit.simulation.evaluation.voodoo import METHODS, conclusions, found_start
    from kinefit.simulation.evaluation.voodoo import evaluate as run_all
    from kinefit.simulation.rendering.sensors import DEPTH_SENSORS

    runs = sequences(count, sensor=DEPTH_SENSORS[sensor], rate=rate, seed=seed)
    first = found_start if start == "found" else None
    with _screen.bars() as step:
        summaries = run_all(
            runs, METHODS[method], start=first, step=lambda done: step(f"{method} on {sensor}", done, count)
        )
    for line in _table(list(summaries.values())):
        _screen.say(line)
    if any(s.named.graded for s in summaries.values()):
        _screen.say()
        _screen.say("the six movements that the paper names:")
        for line in _table([s.named for s in summaries.values()]):
            _screen.say(line)
    _screen.say()
    for text, holds in conclusions(summaries).items():
        _screen.say(f"{'yes' if holds else 'NO ':3}  {text}")
    if _screen.is_verbose():
        _screen.say()
        for line in _movements(list(summaries.values())):
            _screen.say(line)


def _table(summaries: list[Summary]) -> list[str]:
    """Lost, acceptable and good sequences, mean grade and mean error, for every choice of sensors."""
    lines = [f"{'sensors':18}{'lost':>6}{'acceptable':>12}{'good':>6}{'mean grade':>12}{'mean error':>12}"]
    for s in summaries:
        lost, some, good = s.counts
        lines.append(f"{_NAMES[s.inputs]:18}{lost:6d}{some:12d}{good:6d}{s.mean_grade:12.2f}{1e3 * s.error:9.0f} mm")
    return lines


def _movements(summaries: list[Summary]) -> list[str]:
    """Mean grade and mean error of every movement."""
    names = list(dict.fromkeys(g.movement for g in summaries[0].graded))
    lines = [f"{'movement':18}" + "".join(f"{_NAMES[s.inputs]:>22}" for s in summaries)]
    for name in names:
        cells = []
        for s in summaries:
            of = [g.grade for g in s.graded if g.movement == name]
            mean, error = sum(g.grade for g in of) / len(of), sum(g.mean for g in of) / len(of)
            cells.append(f"{mean:.1f}, {1e3 * error:.0f} mm")
        lines.append(f"{name:18}" + "".join(f"{cell:>22}" for cell in cells))
    return lines


@click.command(short_help="Move a motion down a slope; render it from a new camera.", epilog="""\b
Examples:
  kinefit replay motion.npz -o ride.mp4 --speed 6               a video on a slope of 30 degrees
  kinefit replay motion.npz -o ride.npz --speed 6 --gain 1.5    a motion; show it with kinefit view ride.npz
  kinefit replay my_take-kinefit -o both.mp4 --slope 0 --speed 0 --beside my_take-kinefit/overlays/cam01.mp4
""")  # fmt: skip
@click.argument("source", metavar="MOTION", type=_screen.PATH)
@click.option("-o", "--out", required=True, type=_screen.PATH, help="Video (.mp4) or motion (.npz).")
@click.option("--slope", type=float, default=30.0, show_default=True, help="[deg] Slope of the floor.")
@click.option("--heading", type=float, default=0.0, show_default=True, help="[deg] Direction of the fall line.")
@click.option("--speed", type=float, default=4.0, show_default=True, help="[m/s] Initial speed down the slope.")
@click.option("--gain", type=float, default=0.0, show_default=True, help="[m/s²] Acceleration down the slope.")
@click.option("--azimuth", type=float, default=100.0, show_default=True, help="[deg] Camera from the fall line.")
@click.option("--beside", metavar="VIDEO", type=_screen.PATH, help="Video of the same frames to the left of the scene.")
@_screen.verbose_option
def replay(
    source: Path, out: Path, slope: float, heading: float, speed: float, gain: float, azimuth: float,
    beside: Path | None,
) -> None:
    """Place a motion on a slope, move it downhill, and write it as a video or a motion."""
    from kinefit.exporters.motion_file import write_motion
    from kinefit.readers.motion import read_motion
    from kinefit.simulation.figures import film, replayed

    _screen.check_file(out, "--out")
    if beside is not None and out.suffix.lower() == ".npz":
        raise click.UsageError("--beside is for videos: write to a file ending in .mp4, or leave it out.")
    found = source / "motion.npz" if source.is_dir() else source
    moved = replayed(read_motion(found), slope=slope, heading=heading, speed=speed, gain=gain)
    if out.suffix.lower() == ".npz":
        write_motion(moved, out)
    else:
        film(moved, out, slope=slope, heading=heading, azimuth=azimuth, beside=beside)
    _screen.say(f"{out}: {len(moved)} frames")


@click.command(short_help="Retarget a recorded motion (BVH, ASF/AMC) to the humanoid.", epilog="""\b
Examples:
  kinefit retarget walk.bvh
  kinefit retarget 02_01.amc --asf 02.asf --rate 60 --out walk.npz
  kinefit export walk.npz --retarget character.glb
""")  # fmt: skip
@click.argument("recording", type=_screen.PATH)
@click.option("--asf", type=_screen.PATH, help="Skeleton (.asf) of an .amc file.")
@click.option("-o", "--out", type=_screen.PATH, help="Motion file.  [default: RECORDING with .npz]")
@click.option("--rate", type=click.FloatRange(min=0, min_open=True), help="Frames per second.  [default: as recorded]")
@click.option(
    "--names-table", "table", type=_screen.PATH, metavar="TOML",
    help="Lines such as thigh_l = \"JointName\", for joints that are not recognised by name.",
)
@click.option("--unit", metavar="UNIT", default="auto", help="Unit of length: m, cm, mm, in.  [default: by the size]")
@click.option("--up", metavar="AXIS", default="auto", help="Vertical axis: x, y, z, -x ...  [default: feet to head]")
@_screen.verbose_option
def retarget(
    recording: Path, asf: Path | None, out: Path | None, rate: float | None, table: Path | None, unit: str, up: str
) -> None:
    """Retarget a recorded motion to the humanoid, by the directions of its bones."""
    from kinefit.exporters import write_motion
    from kinefit.findings import of_provenance
    from kinefit.readers.skeletons.characters import read_names
    from kinefit.simulation import retarget as retarget_motion

    check_recording(recording, asf, (".bvh", ".amc"), "RECORDING")
    out = out or recording.with_suffix(".npz")
    _screen.check_file(out)
    skeleton = read_skeleton(recording, asf, unit=unit, up=up)
    with _screen.bars() as step:
        step("retargeting", 0, 0)
        motion = retarget_motion(skeleton, rate=rate, names=read_names(table) if table else None)
        step("retargeting", len(motion), len(motion))
        write_motion(motion, out)
    _screen.say(f"{out}: {len(motion)} frames at {motion.rate:g} Hz of the body {motion.body.name}")
    for found in of_provenance(motion.provenance):
        _screen.tell_finding(found)
