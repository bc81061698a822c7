"""`kinefit warmup`: compile the kernels before they are needed."""

from __future__ import annotations

from time import perf_counter

import click

from kinefit.cli import _screen

_EXAMPLES = """\b
Examples:
  kinefit warmup
  KINEFIT_CACHE=/var/cache/kinefit kinefit warmup     keep them in another folder
"""


@click.command(short_help="Compile the kernels now, so that the first track does not wait.", epilog=_EXAMPLES)
@_screen.verbose_option
def warmup(verbose: bool) -> None:
    """Compile the kernels now, so that the first track does not wait; they are kept for later runs."""
    begin = perf_counter()
    with _screen.bars() as step:
        step("compiling", 0, 2)
        from kinefit._jit import kernel_folder

        _video()
        step("compiling", 1, 2)
        _depth()
        step("compiling", 2, 2)
    kept = kernel_folder()
    where = f"the kernels lie in {kept.parent}" if kept else "none can be kept: set KINEFIT_CACHE"
    _screen.say(f"ready after {perf_counter() - begin:.1f} s; {where}")


def _video() -> None:
    from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig
    from kinefit.tracking.recording import Recording
    from kinefit.tracking.video import track

    motion = cut(squat_and_wave(), 0, 4)
    rig = studio_rig(motion)
    track(Recording.of_keypoints(rig, simulate_keypoints(motion, rig, "BODY_25B"), up=motion.up), motion.body)


def _depth() -> None:
    """With no pose given, so that the search for the start is compiled too."""
    from kinefit.geometry.camera import Rig
    from kinefit.motion import UP_AXES
    from kinefit.observations import DepthFrame
    from kinefit.simulation import KINECT, cut, in_front, simulate_depth, squat_and_wave
    from kinefit.tracking.tracker import Tracker

    motion = cut(squat_and_wave(), 0, 3)
    camera = in_front(motion, KINECT.camera(name="kinect"), near=KINECT.near, far=KINECT.far)
    video = simulate_depth(motion, camera, KINECT)
    tracker = Tracker(motion.body, Rig((camera,)), rate=motion.rate, up=UP_AXES[motion.up])
    for i in range(len(motion)):
        tracker.update([DepthFrame("kinect", motion.times[i], video.frame(i).depth)])
