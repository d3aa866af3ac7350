"""Candidates with their features: what the boosting learns from.

The search learns from voxels that pass the gate, the judge from the voxels about the peaks that the search leaves. Each
head is a *bag* of voxels near it of which one has to be found (Viola, Platt and Zhang, 2005); with every fourth voxel
searched there are four lattices to be found in, each a bag.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I16, I32, I64, Frame
from headvox.evolve.bank import GATE, OCCUPIED, SEEN, SUBDIVISION, VOXEL_M, sums_about
from headvox.evolve.views import View
from headvox.fuse import Region
from headvox.gate import pass_gate
from headvox.integral import integral_volume
from headvox.lattice import Lattice
from headvox.masks.cascade import CHANNELS
from headvox.masks.compile import SCORE_UNIT, CompiledGate, CompiledStages
from headvox.suppress import PEAK_REACH, suppress
from headvox.visibility import count_seen
from headvox.vote import DROPPED, score_by_stages
from headvox.voxelize import voxelize_depth, voxelize_points

RANGE_M = 5.0
EDGE_M = 0.2  # heads so near to the end of the range are cut by it
SEARCH_NEAR_M = 0.0560  # from any place to the nearest of every fourth voxel: √5 / 4 of 10 cm
JUDGE_NEAR_M = 0.0434  # from any place to the nearest voxel, √3 / 2 of 5 cm
APART_M, UNCLEAR_APART_M = 0.13, 0.25  # what is nearer to a head is neither it nor not it
AROUND = np.array(list(product((-1, 0, 1), repeat=3)), np.int32)
HARD, EASY = 150, 50  # negatives of a view, at most
MOST_PEAKS, FEW_AROUND = 24, 5

Rng = np.random.Generator


@dataclass(frozen=True)
class Samples:
    """Candidates, one a row: ``label`` 1 a head, 0 none; ``bag`` which head (-1: none); ``sees``: there are cameras.

    ``occupied`` (N, F) and ``seen`` (N, F') are the features of the banks; ``view`` (N,) is the view's number.
    """

    occupied: I16
    seen: I16
    label: npt.NDArray[np.int8]
    bag: I64
    view: I64
    sees: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.label)

    def __getitem__(self, rows: npt.NDArray[Any]) -> Samples:
        return Samples(*(getattr(self, entry.name)[rows] for entry in fields(self)))

    @property
    def aside(self) -> npt.NDArray[np.bool_]:
        """Rows of the views that nothing is fitted to: every tenth of each kind."""
        return is_aside(self.view)


def is_aside(view: I64) -> npt.NDArray[np.bool_]:
    """Tell which views nothing is fitted to: 20 of every 200, so that each kind is among them."""
    return np.asarray(view // 20 % 10 == 9)


def is_for_verification(view: I64) -> npt.NDArray[np.bool_]:
    """Tell of which views the last look learns nothing: the verification starts from honest scores there."""
    return np.asarray(np.isin(view // 20 % 10, (3, 7)))


def join(parts: Iterable[Samples]) -> Samples:
    """Put samples one after the other."""
    listed = list(parts)
    return Samples(
        *(np.concatenate([getattr(part, entry.name) for part in listed]) for entry in fields(Samples))
    )


@dataclass(frozen=True)
class Grid:
    """A frame as an integral volume."""

    frame: Frame
    lattice: Lattice
    S: npt.NDArray[Any]

    @classmethod
    def of(cls, frame: Frame) -> Grid:
        """Voxelize and integrate a frame."""
        lattice = Lattice.over(Region(centre_of(frame), RANGE_M, -0.5, 2.5), VOXEL_M, SUBDIVISION)
        cells = np.zeros(lattice.shape, np.uint8)
        for image in frame.depths:
            cells |= voxelize_depth(image, lattice)
        for cloud in frame.clouds:
            cells |= voxelize_points(cloud, lattice)
        return cls(frame, lattice, integral_volume(cells))

    @property
    def sees(self) -> bool:
        """Whether there is something to know empty and hidden from."""
        return bool(self.frame.depths) and not self.frame.clouds

    def occupied(self, cells: I32) -> I16:
        """Return the features of the occupied bank."""
        return OCCUPIED.features(sums_about(self.S, cells, OCCUPIED.boxes))

    def seen(self, cells: I32) -> I16:
        """Return the features of the seen bank, zeros without a camera."""
        if not self.sees:
            return np.zeros((len(cells), len(SEEN.names)), np.int16)
        counts = count_seen(self.frame.depths, self.lattice, cells, SEEN.boxes)
        channel = np.repeat([CHANNELS.index(g.channel) - 1 for g in SEEN.groups], np.diff(SEEN.start))
        return SEEN.features(counts[:, np.arange(len(channel)), channel])

    def near(self, centre: F64, radius_m: float) -> I32:
        """Return the cells (N, 3) whose centres are within a radius of a place, and in the volume."""
        middle = np.floor((centre - np.array(self.lattice.origin)) / VOXEL_M).astype(np.int64)
        reach = np.arange(-2, 3)
        cells = middle + np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), -1).reshape(-1, 3)
        cells = cells[((cells >= 0) & (cells < np.array(self.S.shape) - 1)).all(axis=1)].astype(np.int32)
        near: I32 = cells[np.linalg.norm(self.lattice.centres(cells) - centre, axis=1) <= radius_m]
        return near


def centre_of(frame: Frame) -> tuple[float, float, float]:
    """Return the middle of the sensors, or the origin where they are not known: the detector's default."""
    origins = [image.T_world_camera[:3, 3] for image in frame.depths]
    origins += [cloud.T_world_sensor[:3, 3] for cloud in frame.clouds if cloud.T_world_sensor is not None]
    x, y, z = np.mean(origins, axis=0).tolist() if origins else (0.0, 0.0, 0.0)
    return x, y, z


def to_find(view: View) -> npt.NDArray[np.bool_]:
    """Tell which heads (N,) of a view a detector should find."""
    distance = np.linalg.norm(view.heads.centres - np.array(centre_of(view.frame)), axis=1)
    return np.asarray(view.heads.clear & (distance < RANGE_M - EDGE_M))


def coset_of(cells: I32) -> I64:
    """Tell which of the four lattices of every fourth voxel each cell (N, 3) is on: 0 to 3."""
    odd = cells & 1
    return ((odd[:, 0] ^ odd[:, 2]) * 2 + (odd[:, 1] ^ odd[:, 2])).astype(np.int64)


def _label(view: View, centres: F64, near_m: float) -> tuple[npt.NDArray[np.int8], I64]:
    """Return the label (-1: neither) and the head of each place; 16 bags a head leave room for lattices."""
    label, bag = np.zeros(len(centres), np.int8), np.full(len(centres), -1, np.int64)
    wanted = to_find(view)
    distances = np.linalg.norm(centres[None] - view.heads.centres[:, None], axis=2)
    for distance, find in zip(distances, wanted, strict=True):
        label[distance < (APART_M if find else UNCLEAR_APART_M)] = -1
    for k, (distance, find) in enumerate(zip(distances, wanted, strict=True)):
        if find:
            label[distance <= near_m] = 1
            bag[distance <= near_m] = 16 * (100 * view.number + k)
    return label, bag


def _few(rows: I64, most: int, rng: Rng) -> I64:
    return rows if len(rows) <= most else np.sort(rng.choice(rows, most, replace=False))


def search_samples(view: View, gate: CompiledGate, miner: CompiledStages | None) -> Samples | None:
    """Return voxels that pass the gate: those of heads, what ``miner`` is wrong about, a few others."""
    grid = Grid.of(view.frame)
    cells = pass_gate(grid.S, gate)
    if len(cells) == 0:
        return None
    rng = np.random.default_rng([view.number, 1])
    label, bag = _label(view, grid.lattice.centres(cells), SEARCH_NEAR_M)
    bag[bag >= 0] += coset_of(cells)[bag >= 0]
    negative = np.flatnonzero(label == 0)
    if miner is None:
        chosen = _few(negative, HARD, rng)
    else:
        wrong = score_by_stages(grid.S, cells[negative], miner) > DROPPED
        chosen = np.concatenate([_few(negative[wrong], HARD, rng), _few(negative[~wrong], EASY, rng)])
    rows = np.concatenate([np.flatnonzero(label == 1), chosen])
    seen = np.zeros((len(rows), 0), np.int16)
    view_of = np.full(len(rows), view.number)
    return Samples(
        grid.occupied(cells[rows]), seen, label[rows], bag[rows], view_of, np.full(len(rows), grid.sees)
    )


def judge_samples(
    view: View, gate: CompiledGate, search: CompiledStages, miner: CompiledStages | None, least: float
) -> Samples | None:
    """Return voxels about the search's peaks, and about heads; after a first round those that ``miner`` liked best."""
    grid = Grid.of(view.frame)
    rng = np.random.default_rng([view.number, 2])
    cells = pass_gate(grid.S, gate)
    cells = cells[coset_of(cells) == rng.integers(4)]
    peaks = np.empty((0, 3), np.int32)
    if len(cells):
        scores = score_by_stages(grid.S, cells, search)
        which = suppress(cells, scores, DROPPED + 1, tuple(n - 1 for n in grid.S.shape), PEAK_REACH[4])
        peaks = cells[which[np.argsort(-scores[which], kind="stable")]]
    about = (peaks[:, None] + AROUND).reshape(-1, 3)
    inside = ((about >= 0) & (about < np.array(grid.S.shape) - 1)).all(axis=1)
    label, _ = _label(view, grid.lattice.centres(about), JUDGE_NEAR_M)
    false = (label.reshape(-1, len(AROUND)) == 0).all(axis=1) if len(peaks) else np.zeros(0, bool)
    inside = inside.reshape(-1, len(AROUND))
    scores = np.zeros(len(about), np.int64)
    asked = np.flatnonzero(inside.reshape(-1) & np.repeat(false, len(AROUND)))
    if miner is not None and len(asked):
        scores[asked] = score_by_stages(grid.S, about[asked], miner)
    chosen: list[I64] = []
    for p in np.flatnonzero(false):
        mine = p * len(AROUND) + np.flatnonzero(inside[p])
        if miner is None:
            chosen.append(_few(mine, FEW_AROUND, rng))
        elif scores[mine].max(initial=DROPPED) >= least * SCORE_UNIT:
            chosen.append(mine[np.argsort(-scores[mine], kind="stable")[:2]])
    chosen = chosen[:MOST_PEAKS]
    negative = about[np.concatenate(chosen)] if chosen else np.empty((0, 3), np.int32)
    heads = (
        [grid.near(centre, JUDGE_NEAR_M) for centre in view.heads.centres[to_find(view)]]
        if miner is None
        else []
    )
    found = np.concatenate([*heads, negative]).astype(np.int32)
    if len(found) == 0:
        return None
    label, bag = _label(view, grid.lattice.centres(found), JUDGE_NEAR_M)
    view_of = np.full(len(found), view.number)
    every = Samples(
        grid.occupied(found), grid.seen(found), label, bag, view_of, np.full(len(found), grid.sees)
    )
    return every[every.label >= 0]


@dataclass(frozen=True)
class GateSums:
    """Signed sums (N, conditions) of the gate about voxels; ``bag`` -1 for voxels that are no head's."""

    sums: I32
    bag: I64

    @classmethod
    def of(cls, view: View) -> GateSums | None:
        """Take them of a view: about its heads, and about a few hundred voxels that have something in the crown."""
        grid = Grid.of(view.frame)
        rng = np.random.default_rng([view.number, 3])
        x, y, z = np.nonzero(grid.S[1:, 1:, 1:])
        rows = np.arange(len(x))
        some = _few(rows, 4000, rng)
        cells = np.stack([x[some], y[some], z[some]], axis=1).astype(np.int32)
        crown = sums_about(grid.S, cells, GATE.boxes[:1])[:, 0]
        cells = cells[crown >= 2]
        label, _ = _label(view, grid.lattice.centres(cells), SEARCH_NEAR_M)
        cells = cells[label == 0][:400]
        heads = [grid.near(centre, SEARCH_NEAR_M) for centre in view.heads.centres[to_find(view)]]
        every = np.concatenate([*heads, cells]).astype(np.int32)
        if len(every) == 0:
            return None
        label, bag = _label(view, grid.lattice.centres(every), SEARCH_NEAR_M)
        bag[bag >= 0] += coset_of(every)[bag >= 0]
        boxes = sums_about(grid.S, every, GATE.boxes)
        weights = np.array([box.weight for group in GATE.groups for box in group.boxes])
        return cls(np.add.reduceat(boxes * weights, GATE.start[:-1], axis=1).astype(np.int32), bag)


def collect(views: Iterable[View], take: Callable[[View], Samples | None]) -> Samples:
    """Return the samples of all views."""
    return join(part for part in map(take, views) if part is not None)


def without_new_heads(samples: Samples) -> Samples:
    """Return the negatives alone: the heads are the same in every round."""
    return samples[samples.label == 0]


def of_bags(samples: Samples, score: npt.NDArray[Any], rows: npt.NDArray[np.bool_]) -> tuple[I64, F64]:
    """Return the bags among ``rows`` and the best score of each."""
    mine = rows & (samples.label == 1)
    bags, where = np.unique(samples.bag[mine], return_inverse=True)
    best = np.full(len(bags), -np.inf)
    np.maximum.at(best, where, score[mine])
    return bags, best
