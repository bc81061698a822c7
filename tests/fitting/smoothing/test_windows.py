"""Windows of a long take."""

import itertools

import numpy as np

from kinefit.fitting.smoothing.border import parts


def test_windows_cover_a_take_once_and_overlap():
    for frames, window, overlap in ((50, 60, 10), (100, 60, 20), (1234, 600, 60), (61, 60, 20)):
        found = parts(frames, window, overlap)
        np.testing.assert_array_equal(np.concatenate([np.arange(frames)[kept] for _, kept in found]), np.arange(frames))
        for whole, kept in found:
            assert whole.start <= kept.start < kept.stop <= whole.stop
            assert kept.start == 0 or kept.start - whole.start >= overlap // 2
        assert all(b[0].start <= a[0].stop - overlap for a, b in itertools.pairwise(found))
        solved = sum(whole.stop - whole.start for whole, _ in found)
        assert solved < frames + (len(found) - 1) * overlap + len(found)  # no frame more than they share
