"""`kinefit body`: list and copy the bodies of the catalogue, and check the closed chains of a body."""

from __future__ import annotations

import math
from pathlib import Path

import click

from kinefit.cli import _screen
from kinefit.errors import FileError


@click.group(cls=_screen.CommandGroup, short_help="List, copy and render bodies; check closed chains.",
             invoke_without_command=True, epilog="""\b
Examples:
  kinefit body                                   list the bodies: people, and people with gear
  kinefit body copy snowboarder                  write snowboarder.toml, to edit and to use in a take
  kinefit body check snowboarder.toml            degrees of freedom, closures, contradictions
  kinefit body refine humanoid_metaballs -o fine.npz    more metaballs a limb, on the same surface
  kinefit body picture cyclist -o cyclist.png    an image of the body with its closures satisfied
""")  # fmt: skip
@click.pass_context
def body(ctx: click.Context) -> None:
    """List, copy and render bodies; check closed chains. Without a command: list."""
    if ctx.invoked_subcommand is not None:
        return
    from kinefit.bodies import catalogue, load_body

    for name in catalogue():
        one = load_body(name)
        gear = [s for s, g in zip(one.tree.segments, one.segment_scale) if one.gear_scale[g]]
        n_dofs = one.tree.n_dofs - 6 * (not one.tree.root_free)
        parts = f"{len(one.tree.segments)} segments, {n_dofs} degrees of freedom"
        if gear:
            parts += f", {len(one.closures)} closure{'s' * (len(one.closures) != 1)}; gear: {', '.join(gear)}"
        _screen.say(f"{name:18s} {parts}")


@body.command(short_help="Copy a body file of the catalogue, to edit.")
@click.argument("name")
@click.argument("file", type=_screen.PATH, required=False)
def copy(name: str, file: Path | None) -> None:
    """Write a body of the catalogue as a TOML file that you can edit."""
    from kinefit.bodies.toml.bodies import catalogue_text

    text, target = catalogue_text(name), file or Path(f"{name}.toml")
    if target.exists():
        raise FileError("this file already exists", file=target, remedy="Give another --out, or move this file.")
    _screen.check_file(target, "FILE")
    target.write_text(text, encoding="utf-8")
    _screen.say(f"{target}: name it in the take, body = \"{target}\"")


@body.command(short_help="Check degrees of freedom and closures of a body.")
@click.argument("file")
@click.option("--planar", is_flag=True, help="Count for planar motion: 3 degrees of freedom instead of 6.")
def check(file: str, planar: bool) -> None:
    """Compare Gruebler's count of a body with the rank of its closures; name redundant and contradictory closures."""
    from kinefit.bodies import load_body
    from kinefit.solving.mobility import check_closed, mobility

    one = load_body(file)
    m = mobility(one, planar=planar)
    _screen.say(f"body '{one.name}': {m.links} links, {m.joints} joints, {m.open_dofs} degrees of freedom as a tree")
    for c in one.closures:
        where = f"'{c.to}'" if c.to else "a world position" + (", to estimate," if c.place_std > 0.0 else "")
        _screen.say(f"  closure '{c.name}': {c.kind}, '{c.point}' and {where}, {'hard' if c.hard else 'soft'}")
    for d in one.dimensions:
        value, unit = (math.degrees(d.value), "deg") if d.turns else (d.value, "m")
        _screen.say(f"  dimension '{d.name}': {value:.4g} {unit}{', to estimate' if d.std > 0.0 else ''}")
    _screen.say(f"Gruebler: F = {m.gruebler}")
    _screen.say(f"rank of the closures: {m.rank} of {m.equations} equations; mobility: {m.mobility}")
    if m.agrees:
        _screen.say("both agree")
    else:
        few = m.mobility - m.gruebler
        _screen.say(f"they differ by {few}, the number of redundant equations: the mechanism is over-constrained")
        for line in m.redundant:
            _screen.say(f"  {line}")
    if m.rank + m.mobility != m.open_dofs:
        _screen.say("the poses are singular: the rank admits directions without finite motion")
    check_closed(one)


@body.command(short_help="Give every limb of metaballs more of them, on the same surface.")
@click.argument("file")
@click.option("--balls", type=click.IntRange(3, 40), default=8, show_default=True, help="Metaballs of each limb.")
@click.option("-o", "--out", type=_screen.PATH, required=True, help="Saved body (.npz), for `body` of a take.")
def refine(file: str, balls: int, out: Path) -> None:
    """Refine a body of three metaballs a limb (a name, a body file, or motion.npz of a fit) to a fuller set."""
    from kinefit.bodies import load_body
    from kinefit.bodies.serial import save_body
    from kinefit.fitting.subject.metaballs import refined_body
    from kinefit.readers.motion import read_motion

    _screen.check_file(out)
    one = read_motion(file).body if Path(file).name == "motion.npz" or Path(file).is_dir() else load_body(file)
    save_body(refined_body(one, balls), out)
    _screen.say(f"{out}: {balls} metaballs a limb; name it in the take, body = \"{out}\"")


@body.command(short_help="Render a body with its closures satisfied.")
@click.argument("file")
@click.option("-o", "--out", type=_screen.PATH, required=True, help="PNG or JPEG file.")
@click.option("--azimuth", type=float, default=40.0, show_default=True, help="[deg] Camera angle, 0 in front.")
def picture(file: str, out: Path, azimuth: float) -> None:
    """Render a body in the pose nearest to its reference pose that satisfies its closures."""
    from kinefit._files import write_image
    from kinefit.bodies import load_body
    from kinefit.simulation.figures import portrait

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise FileError("images are written only as .png or .jpg", file=out, remedy=f"Write to {out.stem}.png.")
    _screen.check_file(out)
    write_image(out, portrait(load_body(file), azimuth))
    _screen.say(str(out))
