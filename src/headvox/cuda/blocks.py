"""Sums over the threads of a block, in an order that is always the same."""

from __future__ import annotations

from headvox.cuda.lanes import device, wait_for_block


@device
def sum_of_all(totals, thread, threads):
    """Return the sum of ``totals`` (threads,), shared by a block whose threads, a power of two, all call this."""
    wait_for_block()
    step = threads // 2
    while step > 0:
        if thread < step:
            totals[thread] += totals[thread + step]
        wait_for_block()
        step //= 2
    total = totals[0]
    wait_for_block()
    return total


@device
def sum_rows(rows, thread, threads):
    """Leave the sum of ``rows`` (threads, N), shared by a block whose threads all call this, in the first of them."""
    wait_for_block()
    step = threads // 2
    while step > 0:
        if thread < step:
            for k in range(rows.shape[1]):
                rows[thread, k] += rows[thread + step, k]
        wait_for_block()
        step //= 2


@device
def share_of(count, thread, threads):
    """Return the half-open range of ``count`` things that a thread does."""
    return count * thread // threads, count * (thread + 1) // threads
