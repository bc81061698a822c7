"""Ctrl-C while frames are tracked."""

from __future__ import annotations

from kinefit.motion import Motion


class TrackingInterrupted(KeyboardInterrupt):
    """Ctrl-C while frames were being tracked; what is done is kept.

    Parameters
    ----------
    motion : Motion of the frames done, from the first one on.
    total : int, how many frames there are.
    """

    def __init__(self, motion: Motion, total: int) -> None:
        super().__init__(f"{len(motion)} of {total} frames are tracked")
        self.motion, self.total = motion, total
