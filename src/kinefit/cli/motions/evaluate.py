"""`kinefit evaluate`: a published experiment, repeated with simulated sensors and graded by the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen

if TYPE_CHECKING:
    from kinefit.evaluation.voodoo import Summary

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
    from kinefit.evaluation.sequences import sequences
    from kinefit.evaluation.voodoo import METHODS, conclusions, found_start
    from kinefit.evaluation.voodoo import evaluate as run_all
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
