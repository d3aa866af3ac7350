"""Bits -> the list of those that are set, in order: counts, their running sums, and then each thread writes its own.

Where a number goes in the list follows from the bits before it, and from no order in which threads happen to run.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.cuda.lanes import kernel

THREADS = 256  # that add up the counts of all shares


@kernel
def count_bits(bits, counts):
    """Write to ``counts`` (frames, shares) how many bits are set in each share of ``bits`` (frames, words)."""
    frame, shares = cuda.blockIdx.y, counts.shape[1]
    each = (bits.shape[1] + shares - 1) // shares
    for share in range(cuda.grid(1), shares, cuda.gridsize(1)):
        found = 0
        for k in range(share * each, min((share + 1) * each, bits.shape[1])):
            found += cuda.popc(bits[frame, k])
        counts[frame, share] = found


@kernel
def add_up(counts, total, which):
    """Replace ``counts`` (frames, shares) by the sums of those before each; write the whole to ``total[:, which]``.

    One block a frame.
    """
    sums = cuda.shared.array(THREADS, np.int64)
    frame, thread, threads, shares = cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x, counts.shape[1]
    each = (shares + threads - 1) // threads
    first, after = thread * each, min((thread + 1) * each, shares)
    mine = 0
    for k in range(first, after):
        mine += counts[frame, k]
    sums[thread] = mine
    cuda.syncthreads()
    before = 0
    for k in range(thread):
        before += sums[k]
    for k in range(first, after):
        count = counts[frame, k]
        counts[frame, k] = before
        before += count
    if thread == threads - 1:
        total[frame, which] = before


@kernel
def list_bits(bits, before, listed):
    """Write the numbers of the bits that are set to ``listed`` (frames, N), in order, as far as they fit.

    ``before`` (frames, shares) tells how many are set before each share, see :func:`count_bits`.
    """
    frame, shares = cuda.blockIdx.y, before.shape[1]
    each = (bits.shape[1] + shares - 1) // shares
    for share in range(cuda.grid(1), shares, cuda.gridsize(1)):
        at = before[frame, share]
        for k in range(share * each, min((share + 1) * each, bits.shape[1])):
            word = bits[frame, k]
            if word == 0:
                continue
            for bit in range(32):
                if word >> np.uint32(bit) & np.uint32(1):
                    if at < listed.shape[1]:
                        listed[frame, at] = 32 * k + bit
                    at += 1
