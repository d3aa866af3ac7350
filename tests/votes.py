"""The compiled votes over a volume that is one slab, as a detector has it cut and with margins."""

from __future__ import annotations

import numpy as np

from headvox.data import I32, I64
from headvox.integral import Integral, box_reach, with_margins
from headvox.masks.compile import CompiledVotes
from headvox.slabs import ONE_SLAB
from headvox.vote import vote_masks


def score_by_votes(S: Integral, cells: I32, votes: CompiledVotes) -> tuple[I64, I32]:
    """Return each candidate's score, in units of 1/1024, and the index of its best yaw; 0 where it is dropped."""
    scores = np.empty(len(cells), np.int64)
    best_yaw = np.zeros(len(cells), np.int32)
    table = (
        votes.boxes,
        votes.weights,
        votes.start,
        votes.masks,
        votes.pairs,
        votes.asymmetry_cost,
        votes.min_votes,
    )
    reach = box_reach(np.concatenate([votes.boxes, votes.pairs.reshape(-1, 6)]))
    S, cells = with_margins(S, reach), cells - reach[0::2].astype(np.int32)
    vote_masks(S, *ONE_SLAB, cells, 0, len(cells), *table, scores, best_yaw)
    return scores, best_yaw
