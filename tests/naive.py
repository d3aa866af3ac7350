"""The slow and obvious twin of the whole flow, to hold the fast one equal to; naive_NAME.py has its stages.

Plain loops and plain sums. Nothing here or there is shared with the package but its data classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from naive_search import (
    DROPPED,
    SCORE_UNIT,
    gate,
    names_in,
    score_by_stages,
    score_by_votes,
    suppress,
    suppress_overlaps,
)
from naive_sphere import fit_spheres
from naive_visibility import States, is_seen
from naive_voxels import Grid, about, lattice_over, voxel_box

from headvox.data import Frame
from headvox.fuse import Region
from headvox.masks.cascade import Cascade


def best_about(amount: np.ndarray, cells, cascade: Cascade, voxel: float) -> tuple[np.ndarray, list[int]]:
    """Return for each peak the voxel about it that the judge likes best, and its score; no voxel twice."""
    best = {}
    for cell in cells.tolist():
        steps = {1: 0, 2: 1, 4: 3}[cascade.spacing]  # to the voxels that were no candidates
        around = [d for d in product((-1, 0, 1), repeat=3) if sum(map(abs, d)) <= steps]
        about = [tuple(cell[k] + d[k] for k in range(3)) for d in around]
        scores = [score_by_stages(amount, c, cascade, voxel, judge=True) for c in about]
        if max(scores) > DROPPED:
            best.setdefault(about[scores.index(max(scores))], max(scores))
    return np.array(list(best), np.int32).reshape(-1, 3), list(best.values())


@dataclass
class Found:
    centres: np.ndarray
    scores: list[float]
    radii: list[float]
    candidates: int


def detect(frame: Frame, cascade: Cascade, region: Region, min_score: float | None = None) -> Found:
    """Return the heads in ``frame``, over the whole region: nothing is cropped, nothing is remembered."""
    voxel, counting = cascade.voxel_m, cascade.counting
    lattice = lattice_over(region, voxel, cascade.subdivision)
    grid = Grid(lattice)
    for cloud in frame.clouds:
        grid.enter_cloud(cloud)
    for image in frame.depths:
        grid.enter_depth(image)
    amount = grid.amounts(counting)
    candidates = gate(amount, cascade, voxel, [round(v / voxel) for v in lattice.origin])
    if cascade.votes is not None:
        scores = [score_by_votes(amount, cell, cascade.votes, voxel)[0] for cell in candidates]
    else:
        scores = [score_by_stages(amount, cell, cascade, voxel) for cell in candidates]
    scores = np.array(scores, np.int64)
    peaks = suppress(candidates, scores, DROPPED + 1, 2 if cascade.spacing == 4 else 1)

    seeing = {group.name for group in cascade.groups if group.channel != "occupied"}
    asks = {
        n.rsplit(".", 1)[0] for stage in cascade.judge for tree in stage.trees for n in names_in(tree)
    } & seeing
    sees = bool(asks) and bool(frame.depths)
    cells, scores = candidates[peaks], scores[peaks]
    if cascade.judge:
        cells, scores = best_about(amount, cells, cascade, voxel)
        if sees:
            states, by_occupancy = States(frame.depths, lattice), scores
            scores = [score_by_stages(amount, cell, cascade, voxel, states, judge=True) for cell in cells]
            if frame.clouds:
                more = round((cascade.min_score - cascade.min_score_occupied) * SCORE_UNIT)
                boxes = [box for group in cascade.groups if group.name in asks for box in group.boxes]
                for k, cell in enumerate(cells):
                    if not is_seen(states, [about(cell, voxel_box(box, voxel)) for box in boxes]):
                        scores[k] = by_occupancy[k] + more
    scores = np.array(scores, np.int64)
    if min_score is None:
        min_score = cascade.min_score if sees or not asks else cascade.min_score_occupied
    high = scores >= min_score * SCORE_UNIT
    cells, scores = cells[high], scores[high]
    spheres = fit_spheres(grid.counts if counting else grid.bits, cells, voxel, cascade.subdivision)
    middles = (cells + 0.5) * voxel + np.array(lattice.origin)
    placed = [c.T_world_sensor for c in frame.clouds if c.T_world_sensor is not None]
    placed += [image.T_world_camera for image in frame.depths]
    origins = np.array([T[:3, 3] for T in placed]).reshape(-1, 3)
    centres = middles + spheres[:, :3]
    if len(origins):
        centres[:, 2] -= 0.0135
    kept = suppress_overlaps(centres, scores, 0.18)
    return Found(
        centres[kept],
        [scores[k] / SCORE_UNIT for k in kept],
        [spheres[k, 3] for k in kept],
        len(candidates),
    )
