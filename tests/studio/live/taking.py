"""What tests of cameras and folders do alike: pictures, and what came of them."""

import time

import numpy as np


def image(value):
    return np.full((48, 64, 3), value, np.uint8)


def taken(inbox, count, limit=20.0):
    out, until = [], time.monotonic() + limit
    while len(out) < count and time.monotonic() < until:
        out += inbox.take(0.1)
    return out
