"""Compiled decompression of LZF (Marc Lehmann's liblzf), as binary_compressed PCD files use it."""

from __future__ import annotations

from kinefit._jit import jit


@jit
def lzf(packed, out):
    """Decompress bytes (uint8) into `out`; return the number of bytes written, -1 if the data is broken."""
    end, size, i, n = len(packed), len(out), 0, 0
    while i < end:
        control = int(packed[i])
        i += 1
        if control < 32:  # a run of control + 1 literal bytes
            run = control + 1
            if i + run > end or n + run > size:
                return -1
            for k in range(run):
                out[n + k] = packed[i + k]
            i += run
        else:  # a copy of earlier output; it may overlap itself
            run, back = control >> 5, (control & 31) << 8
            if i + (2 if run == 7 else 1) > end:
                return -1
            if run == 7:
                run += int(packed[i])
                i += 1
            run += 2
            start = n - back - int(packed[i]) - 1
            i += 1
            if start < 0 or n + run > size:
                return -1
            for k in range(run):
                out[n + k] = out[start + k]
        n += run
    return n
