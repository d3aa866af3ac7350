"""Many small trees as a loop walks them fastest: all a step at a time, with one number to read for each.

A node is a number of 64 bits: in the lowest 16 which measure it asks for, in the next 16 the cut (signed), in the
others the node that follows for at most the cut; the one for above it comes next. A leaf leads to itself, with a cut
that no measure exceeds. Nodes lie level by level, those of all trees together, so that what every candidate asks
shares lines of the cache.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from headvox.data import I32, I64
from headvox.machine.kernels import bare_kernel
from headvox.masks.cascade import Tree

GREATEST = np.iinfo(np.int16).max
"""A cut of 16 bits that nothing exceeds: measures are less."""


class Forest(NamedTuple):
    """Trees whose leaves are added up."""

    nodes: I64
    leaves: I32
    """What a node weighs, if it is a leaf."""
    roots: I64
    deepest: int
    """How many steps the deepest tree takes."""


def plant(
    trees: Sequence[Tree], asked: Callable[[str, float], tuple[int, int]], weight: Callable[[float], int]
) -> Forest:
    """Return ``trees`` in numbers.

    ``asked`` turns name and cut of a node into a measure below 65,536 and a whole number, ``weight`` a leaf into one.
    """
    nodes, leaves, steps, level = [0] * len(trees), [0] * len(trees), 0, list(enumerate(trees))
    while level:
        following: list[tuple[int, Tree]] = []
        for at, tree in level:
            if not isinstance(tree, tuple):
                nodes[at], leaves[at] = _node(0, GREATEST, at), weight(tree)
                continue
            name, cut, *both = tree
            nodes[at] = _node(*asked(name, cut), len(nodes))
            following += enumerate(both, len(nodes))
            nodes += (0, 0)
            leaves += (0, 0)
        level, steps = following, steps + (len(following) > 0)
    roots = np.arange(len(trees))
    return Forest(np.array(nodes, np.int64), np.array(leaves, np.int32), roots, steps)


def _node(measure: int, cut: int, follows: int) -> int:
    return follows << 32 | (min(max(cut, -GREATEST - 1), GREATEST) & 0xFFFF) << 16 | measure


@bare_kernel
def sum_of_leaves(measured, nodes, leaves, roots, deepest, at):
    """Return what the trees of ``roots`` (T,) say of what was ``measured`` (M,), less than GREATEST.

    ``at`` (T,) is for its use. For the others see :class:`Forest`.
    """
    for t in range(np.uint64(roots.shape[0])):
        at[t] = roots[t]
    for _ in range(deepest):  # all trees, a step at a time: no step has to wait for the one before
        for t in range(np.uint64(roots.shape[0])):
            node = nodes[np.uint64(at[t])]
            cut = node << 32 >> 48  # with its sign
            at[t] = (node >> 32) + (measured[np.uint64(node & 0xFFFF)] > cut)
    total = np.int64(0)
    for t in range(np.uint64(roots.shape[0])):
        total += leaves[np.uint64(at[t])]
    return total
