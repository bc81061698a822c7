"""Figures of kinefit, each printed by a command; peers run side by side. Nothing here may import kinefit at once.

`python -m benchmarks` runs all areas, `python -m benchmarks --quick` a quick form of each that tells whether every
figure can still be measured, `python -m benchmarks AREA [PART ...] [--quick]` one area or some of its parts. Whole runs
log their figures, unless `--no-log` is given; `python -m benchmarks.page` makes docs/figures.md of the log.
"""
