"""`kinefit retarget`: a recorded skeleton's motion on the humanoid."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen


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
    from kinefit.cli.motions.simulate import check_recording, read_skeleton
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
