"""Masks as data: a cascade is a TOML file in metres, compiled here to voxel offsets for any voxel size.

A *box* has a centre and a size, relative to the candidate. A *group* is one box or a ring of boxes about the vertical
axis; the sums of a ring are sorted, which makes its statistics independent of yaw without any search. All limits and
cuts are *shares*: the sum of the boxes divided by their volume, so a file says the same at every voxel size. On a parts
grid a share of 1 is a box filled with points; on a count grid it is the mean number of points a voxel.

Compiled, everything is integer: boxes are offsets, cuts are sums, leaf weights are multiples of 1/1024.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.errors import HeadvoxError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

FORMAT = "headvox-cascade"
CHANNELS = ("occupied", "empty", "hidden")
# smallest, 3rd smallest, 3rd largest, largest, all together
STATISTICS = ("min", "low", "high", "max", "sum")
SCORE_UNIT = 1024
SPACINGS = {"all": 1, "every other": 2, "every fourth": 4}
MAX_FILE_BYTES = 8 << 20
MAX_EXTENT_M = 2.0
MAX_SEEN_CELLS = 1 << 20
LARGEST = 1e9  # of shares and scores: their sums stay far within 64 bits


@dataclass(frozen=True, slots=True)
class Box:
    """A box about ``centre`` (m, from the candidate), ``size`` long (m), counted ``weight`` times."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    weight: int = 1


@dataclass(frozen=True, slots=True)
class Group:
    """Boxes that are looked at together, in one channel."""

    name: str
    boxes: tuple[Box, ...]
    channel: str = "occupied"


@dataclass(frozen=True, slots=True)
class Condition:
    """Stage 1: a statistic of a group's sums must lie between two shares.

    ``rank`` 0 is the weighted sum, as a share of the volume of the boxes of positive weight; k is the kth smallest.
    """

    group: Group
    rank: int
    minimum: float
    maximum: float


@dataclass(frozen=True, slots=True)
class Mask:
    """Stage 2 of the paper: the sign of the weighted sum of the boxes is one vote."""

    name: str
    boxes: tuple[Box, ...]


@dataclass(frozen=True, slots=True)
class Votes:
    """Masks that vote at several yaws, and mirrored pairs of boxes whose difference costs ``asymmetry_cost``."""

    masks: tuple[Mask, ...]
    mirrored: tuple[tuple[Box, Box], ...]
    yaws_deg: tuple[float, ...]
    asymmetry_cost: float
    min_votes: int


# a leaf's weight, or (feature, cut, at most the cut, above it)
Tree = float | tuple[str, float, "Tree", "Tree"]


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of a boosted sum of look-ups; a candidate whose sum so far is below ``keep`` is dropped."""

    name: str
    keep: float
    trees: tuple[Tree, ...]


@dataclass(frozen=True, slots=True)
class Cascade:
    """A cascade as its file has it. Exactly one of ``votes`` and ``stages`` is there."""

    name: str
    summary: str
    voxel_m: float
    subdivision: int
    counting: bool
    conditions: tuple[Condition, ...]
    votes: Votes | None
    groups: tuple[Group, ...]
    stages: tuple[Stage, ...]
    min_score: float
    min_score_occupied: float
    tuned_on: tuple[str, ...]
    spacing: int = 1
    """1: every voxel is a candidate; 2: every other, as the black squares of a chess board are; 4: every fourth."""
    judge: tuple[Stage, ...] = ()
    """Stages that score the voxels about the peaks of ``stages`` anew."""

    @property
    def every_stage(self) -> tuple[Stage, ...]:
        """All stages, those that search and judge both once."""
        return self.stages + tuple(stage for stage in self.judge if stage not in self.stages)

    @property
    def sees(self) -> bool:
        """Whether some stage asks what the sensors saw to be empty or hidden."""
        used = {
            name.rpartition(".")[0] for stage in self.judge for tree in stage.trees for name, _ in cuts(tree)
        }
        return any(group.channel != "occupied" for group in self.groups if group.name in used)


def cuts(tree: Tree) -> Iterator[tuple[str, float]]:
    """Yield the cuts of a tree as (feature, share)."""
    if isinstance(tree, tuple):
        yield tree[0], tree[1]
        yield from cuts(tree[2])
        yield from cuts(tree[3])


# ---------------------------------------------------------------------------------------------------- reading


def shipped_cascades() -> list[str]:
    """Return the names of the cascades that ship with headvox."""
    folder = resources.files("headvox") / "cascades"
    return sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_cascade(name_or_path: str | Path) -> Cascade:
    """Return a cascade that ships with headvox, by name, or one from a file.

    Raises:
        HeadvoxError: no such cascade, or the file is not a cascade; the message names the entry.
    """
    name = str(name_or_path)
    if name in shipped_cascades():
        return parse_cascade(
            (resources.files("headvox") / "cascades" / f"{name}.toml").read_text("utf-8"), name
        )
    path = Path(name)
    if not path.is_file():
        raise HeadvoxError(
            f"Unknown cascade {name!r}: expected {' or '.join(shipped_cascades())}, or the path of a cascade file.",
            "Check the name, or the path.",
        )
    if path.stat().st_size > MAX_FILE_BYTES:
        raise HeadvoxError(
            f"Cascade {name}: larger than {MAX_FILE_BYTES >> 20} MiB.", "That is no cascade file."
        )
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise HeadvoxError(f"Cascade {name} cannot be read: {error}.", "Expected a TOML text file.") from None
    return parse_cascade(text, name)


def parse_cascade(text: str, origin: str) -> Cascade:
    """Return the cascade that the TOML ``text`` describes; ``origin`` names it in errors."""
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, or a whole number of too many digits
        raise HeadvoxError(f"Cascade {origin} is not TOML: {error}.", "Check that line.") from None
    return _Reader(origin).cascade(table)


class _Reader:
    """Reads tables; every error names the cascade and the entry."""

    def __init__(self, origin: str) -> None:
        self.origin = origin

    def error(self, where: str, expected: str, got: object) -> HeadvoxError:
        try:
            shown = repr(got)
        except ValueError:  # Python does not write whole numbers of more than 4300 digits
            shown = "a number of thousands of digits"
        shown = shown if len(shown) < 80 else shown[:77] + "..."
        return HeadvoxError(
            f"Cascade {self.origin}: {where}: expected {expected}, got {shown}.", "Mend the file."
        )

    def table(self, value: object, where: str, known: set[str]) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self.error(where, "a table", value)
        unknown = sorted(set(value) - known)
        if unknown:
            raise self.error(where, f"only {', '.join(sorted(known))}", unknown[0])
        return value

    def items(self, value: object, where: str) -> list[Any]:
        if not isinstance(value, list):
            raise self.error(where, "a list", value)
        return value

    def number(self, value: object, where: str, low: float = -LARGEST, high: float = LARGEST) -> float:
        number = math.nan
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            with suppress(OverflowError):
                number = float(value)
        if not low <= number <= high:
            raise self.error(where, f"a number from {low:g} to {high:g}", value)
        return number

    def whole(self, value: object, where: str, low: int, high: int) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self.error(where, f"a whole number from {low} to {high}", value)
        return value

    def text(self, value: object, where: str) -> str:
        if not isinstance(value, str) or not value:
            raise self.error(where, "text", value)
        return value

    def triple(self, value: object, where: str, low: float, high: float) -> tuple[float, float, float]:
        values = self.items(value, where)
        if len(values) != 3:
            raise self.error(where, "three numbers", value)
        x, y, z = (self.number(v, where, low, high) for v in values)
        return x, y, z

    def box(self, value: object, where: str, weighted: bool = False) -> Box:
        table = self.table(value, where, {"centre", "size", "weight"} if weighted else {"centre", "size"})
        centre = self.triple(table.get("centre"), f"{where}.centre", -MAX_EXTENT_M, MAX_EXTENT_M)
        size = self.triple(table.get("size"), f"{where}.size", 0.0, MAX_EXTENT_M)
        return Box(centre, size, self.whole(table.get("weight", 1), f"{where}.weight", -1000, 1000))

    def boxes(self, table: dict[str, Any], where: str, weighted: bool = False) -> tuple[Box, ...]:
        if ("ring" in table) == ("boxes" in table):
            raise self.error(where, "either boxes or ring", sorted(table))
        if "boxes" in table:
            entries = self.items(table["boxes"], f"{where}.boxes")
            boxes = tuple(self.box(entry, f"{where}.boxes", weighted) for entry in entries)
        else:
            boxes = self.ring(table["ring"], f"{where}.ring")
        if not 1 <= len(boxes) <= 64:
            raise self.error(where, "1 to 64 boxes", len(boxes))
        return boxes

    def ring(self, value: object, where: str) -> tuple[Box, ...]:
        table = self.table(value, where, {"radius", "height", "size", "count"})
        radius = self.number(table.get("radius"), f"{where}.radius", 0.0, MAX_EXTENT_M)
        height = self.number(table.get("height"), f"{where}.height", -MAX_EXTENT_M, MAX_EXTENT_M)
        size = self.triple(table.get("size"), f"{where}.size", 0.0, MAX_EXTENT_M)
        count = self.whole(table.get("count", 8), f"{where}.count", 3, 64)
        return ring(radius, height, size, count)

    def condition(self, value: object, where: str) -> Condition:
        table = self.table(value, where, {"name", "boxes", "ring", "rank", "min", "max"})
        name = self.text(table.get("name"), f"{where}.name")
        boxes = self.boxes(table, f"gate {name}", weighted=True)
        rank = self.whole(table.get("rank", 0), f"gate {name}.rank", 0, len(boxes))
        if rank and any(box.weight != 1 for box in boxes):
            raise self.error(f"gate {name}", "no weights beside a rank", rank)
        if all(box.weight <= 0 for box in boxes):
            raise self.error(f"gate {name}", "a box of positive weight", [box.weight for box in boxes])
        return Condition(
            Group(name, boxes),
            rank,
            self.number(table.get("min", -math.inf), f"gate {name}.min", -math.inf),
            self.number(table.get("max", math.inf), f"gate {name}.max", -LARGEST, math.inf),
        )

    def group(self, value: object, where: str) -> Group:
        table = self.table(value, where, {"name", "boxes", "ring", "channel"})
        name = self.text(table.get("name"), f"{where}.name")
        channel = self.text(table.get("channel", "occupied"), f"group {name}.channel")
        if channel not in CHANNELS:
            raise self.error(f"group {name}.channel", " or ".join(CHANNELS), channel)
        boxes = self.boxes(table, f"group {name}")
        if 1 < len(boxes) < 3:
            raise self.error(f"group {name}", "one box, or at least three", len(boxes))
        return Group(name, boxes, channel)

    def votes(self, value: object) -> Votes:
        table = self.table(value, "votes", {"mask", "mirrored", "yaws_deg", "asymmetry_cost", "min_votes"})
        masks = []
        for entry in self.items(table.get("mask"), "votes.mask"):
            mask = self.table(entry, "votes.mask", {"name", "boxes"})
            name = self.text(mask.get("name"), "votes.mask.name")
            masks.append(Mask(name, self.boxes(mask, f"mask {name}", weighted=True)))
        pairs = []
        for entry in self.items(table.get("mirrored", []), "votes.mirrored"):
            pair = self.items(entry, "votes.mirrored")
            if len(pair) != 2:
                raise self.error("votes.mirrored", "pairs of boxes", entry)
            pairs.append((self.box(pair[0], "votes.mirrored"), self.box(pair[1], "votes.mirrored")))
        yaws = self.items(table.get("yaws_deg", [0.0]), "votes.yaws_deg")
        if not 1 <= len(yaws) <= 64 or not masks:
            raise self.error("votes", "at least one mask and 1 to 64 yaws", len(yaws))
        return Votes(
            tuple(masks),
            tuple(pairs),
            tuple(self.number(yaw, "votes.yaws_deg", -360.0, 360.0) for yaw in yaws),
            self.number(table.get("asymmetry_cost", 0.0), "votes.asymmetry_cost", 0.0, 1e6),
            self.whole(table.get("min_votes", 0), "votes.min_votes", 0, len(masks)),
        )

    def tree(self, value: object, features: set[str], where: str, depth: int = 0) -> Tree:
        if not isinstance(value, list):
            return self.number(value, where, -1000.0, 1000.0)
        if len(value) != 4 or depth > 30:
            raise self.error(where, "[feature, cut, at most, above], 30 deep at most", value)
        feature = self.text(value[0], where)
        if feature not in features:
            raise self.error(where, "a statistic of a group of this file, as ring.max", feature)
        cut = self.number(value[1], where)
        return (
            feature,
            cut,
            self.tree(value[2], features, where, depth + 1),
            self.tree(value[3], features, where, depth + 1),
        )

    def stage(self, value: object, features: set[str]) -> tuple[Stage, str]:
        """Return a stage, and where it looks: at "candidates", "peaks" or "both"."""
        table = self.table(value, "stage", {"name", "at", "keep", "trees"})
        name = self.text(table.get("name"), "stage.name")
        at = self.text(table.get("at", "candidates"), f"stage {name}.at")
        if at not in ("candidates", "peaks", "both"):
            raise self.error(f"stage {name}.at", '"candidates", "peaks" or "both"', at)
        trees = self.items(table.get("trees"), f"stage {name}.trees")
        stage = Stage(
            name,
            self.number(table.get("keep", -math.inf), f"stage {name}.keep", -math.inf, math.inf),
            tuple(self.tree(tree, features, f"stage {name}.trees") for tree in trees),
        )
        return stage, at

    def cascade(self, value: dict[str, Any]) -> Cascade:
        known = {"format", "version", "name", "summary", "voxel_m", "subdivision", "occupancy", "gate"}
        known |= {"votes", "group", "stage", "min_score", "min_score_occupied", "tuned_on", "candidates"}
        table = self.table(value, "the file", known)
        if table.get("format") != FORMAT or table.get("version") != 1:
            raise self.error("format, version", f'"{FORMAT}", 1', (table.get("format"), table.get("version")))
        occupancy = self.text(table.get("occupancy"), "occupancy")
        if occupancy not in ("parts", "count"):
            raise self.error("occupancy", '"parts" or "count"', occupancy)
        subdivision = self.whole(table.get("subdivision", 1), "subdivision", 1, 2)
        if occupancy == "count" and subdivision > 1:
            raise self.error("subdivision", '1, as occupancy is "count"', subdivision)
        if table.get("stage") == []:
            raise self.error("stage", "at least one stage", [])
        if ("votes" in table) == ("stage" in table):
            raise self.error("the file", "either votes or stages", sorted(table))
        groups = tuple(self.group(entry, "group") for entry in self.items(table.get("group", []), "group"))
        names: set[str] = set()
        for group in groups:
            if group.name in names:
                raise self.error(f"group {group.name}", "a name of its own", group.name)
            names.add(group.name)
        features = {f"{group.name}.{statistic}" for group in groups for statistic in statistics(group)}
        conditions = tuple(
            self.condition(entry, "gate") for entry in self.items(table.get("gate", []), "gate")
        )
        if all(condition.minimum <= 0.0 for condition in conditions):
            raise self.error(
                "gate", "a condition with min above 0, as only places near points are searched", "none"
            )
        every = [self.stage(entry, features) for entry in self.items(table.get("stage", []), "stage")]
        stages = tuple(stage for stage, at in every if at != "peaks")
        judge = tuple(stage for stage, at in every if at != "candidates")
        if every and not stages:
            raise self.error("stage", 'at least one stage at "candidates"', "none")
        blind = {group.name for group in groups if group.channel == "occupied"}
        for stage in (*stages, *judge[:1]):
            for tree in stage.trees:
                for feature, _ in cuts(tree):
                    if feature.rpartition(".")[0] not in blind:
                        # Neighbours compete by what is occupied; only the winners are looked at through the cameras.
                        where = "as neighbours compete by it"
                        raise self.error(f"stage {stage.name}", f'only "occupied" groups, {where}', feature)
        min_score = self.number(table.get("min_score"), "min_score")
        candidates = self.text(table.get("candidates", "all"), "candidates")
        if candidates not in SPACINGS:
            raise self.error("candidates", " or ".join(f'"{name}"' for name in SPACINGS), candidates)
        return Cascade(
            name=self.text(table.get("name"), "name"),
            summary=self.text(table.get("summary"), "summary"),
            voxel_m=self.number(table.get("voxel_m"), "voxel_m", 0.005, 0.2),
            subdivision=subdivision,
            counting=occupancy == "count",
            conditions=conditions,
            votes=self.votes(table["votes"]) if "votes" in table else None,
            groups=groups,
            stages=stages,
            min_score=min_score,
            min_score_occupied=self.number(table.get("min_score_occupied", min_score), "min_score_occupied"),
            tuned_on=tuple(
                self.text(entry, "tuned_on") for entry in self.items(table.get("tuned_on", []), "tuned_on")
            ),
            spacing=SPACINGS[candidates],
            judge=judge,
        )


def statistics(group: Group) -> tuple[str, ...]:
    """Return the statistics that a group offers: a single box has only its sum."""
    return STATISTICS if len(group.boxes) > 1 else ("sum",)


def ring(radius: float, height: float, size: tuple[float, float, float], count: int = 8) -> tuple[Box, ...]:
    """Return ``count`` boxes on a horizontal circle, the first in the direction of x."""
    angles = [2.0 * math.pi * k / count for k in range(count)]
    return tuple(Box((radius * math.cos(a), radius * math.sin(a), height), size) for a in angles)


def turned(box: Box, yaw_rad: float) -> Box:
    """Return ``box`` with its centre turned about the vertical axis. Boxes stay aligned with the axes."""
    x, y, z = box.centre
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return Box((c * x - s * y, s * x + c * y, z), box.size, box.weight)


# ---------------------------------------------------------------------------------------------------- compiling


def voxel_range(centre: float, size: float, voxel_m: float) -> tuple[int, int]:
    """Return the half-open range of voxels, from the candidate's, that a box covers along one axis.

    It is as many voxels as the size is near to, at least one; ties move away from the candidate, so that mirrored
    boxes stay mirrored.
    """
    count = max(1, round(size / voxel_m))
    steps = round(centre / voxel_m, 6)  # 0.075 / 0.025 is not 3 in binary
    first = steps - (count - 1) / 2
    start = math.floor(first + 0.5) if steps >= 0 else math.ceil(first - 0.5)
    return start, start + count


def voxel_box(box: Box, voxel_m: float) -> list[int]:
    """Return x0 x1 y0 y1 z0 z1, half-open, in voxels from the candidate's."""
    return [edge for c, s in zip(box.centre, box.size, strict=True) for edge in voxel_range(c, s, voxel_m)]


def volume(boxes: I32) -> int:
    """Return the number of voxels in ``boxes`` (B, 6), overlaps counted as often as they occur."""
    return int(np.prod(boxes[:, 1::2] - boxes[:, 0::2], axis=1).sum())


@dataclass(frozen=True, slots=True)
class CompiledGate:
    """Stage 1 in voxels: condition i asks boxes ``start[i]`` to ``start[i + 1]`` for ``low[i] <= . <= high[i]``."""

    boxes: I32
    weights: I32
    start: I32
    rank: I32
    low: I64
    high: I64
    spacing: int


@dataclass(frozen=True, slots=True)
class CompiledVotes:
    """The paper's stage 2 in voxels; boxes and weights of yaw y, mask m are ``start[y * masks + m]`` onwards."""

    boxes: I32
    weights: I32
    start: I32
    masks: int
    pairs: I32
    """(yaws, pairs, 2, 6)"""
    yaws_rad: npt.NDArray[np.float64]
    asymmetry_cost: float
    min_votes: int


@dataclass(frozen=True, slots=True)
class CompiledStages:
    """The boosted stage 2 in voxels.

    Group g has boxes ``group_start[g]`` to ``group_start[g + 1]``; its statistics are features 5 g to 5 g + 4. A node
    is four numbers: feature, cut, and where the nodes for at most the cut and for above it begin. A leaf is a node
    whose cut is its weight and which leads to itself, so that every path of a tree is ``depth`` steps long. Stage s
    needs the groups before ``stage_groups[s + 1]`` and adds the trees ``stage_trees[s]`` to ``stage_trees[s + 1]``.
    """

    boxes: I32
    group_start: I32
    group_channel: I32
    nodes: I64
    root: I64
    depth: I32
    stage_groups: I32
    stage_trees: I32
    stage_keep: I64
    occupied_stages: int
    """How many stages, from the first, do without the channels "empty" and "hidden"."""


@dataclass(frozen=True, slots=True)
class CompiledCascade:
    """A cascade for one voxel size, all integer."""

    source: Cascade
    voxel_m: float
    gate: CompiledGate
    votes: CompiledVotes | None
    stages: CompiledStages | None
    judge: CompiledStages | None
    largest_sum: int
    """Volume in voxel parts of the largest thing that is summed: tells which integer type an integral volume needs."""


def compile_cascade(cascade: Cascade, voxel_m: float | None = None) -> CompiledCascade:
    """Return ``cascade`` in voxels of ``voxel_m`` (its own by default)."""
    voxel = cascade.voxel_m if voxel_m is None else voxel_m
    unit = 1 if cascade.counting else cascade.subdivision**3
    gate = _compile_gate(cascade, voxel, unit)
    votes = _compile_votes(cascade.votes, voxel) if cascade.votes else None
    stages = _compile_stages(cascade, cascade.stages, voxel, unit) if cascade.stages else None
    judge = _compile_stages(cascade, cascade.judge, voxel, unit) if cascade.judge else None
    # The gate adds up the boxes of a condition in the type of the volume, signed; stage 2 adds up in 64 bits.
    sums = [
        2
        * sum(
            abs(int(w)) * volume(box[None]) for w, box in zip(gate.weights[a:b], gate.boxes[a:b], strict=True)
        )
        for a, b in zip(gate.start[:-1], gate.start[1:], strict=True)
    ]
    tables = [gate.boxes]
    if votes:
        tables += [votes.boxes, votes.pairs.reshape(-1, 6)]
    tables += [part.boxes for part in (stages, judge) if part]
    sums += [volume(box[None]) for table in tables for box in table]
    largest = max(sums, default=1) * unit
    if largest > 0xFFFFFFFF:
        raise HeadvoxError(
            f"Cascade {cascade.name}: in voxels of {voxel:g} m a condition of its gate outgrows 32 bits.",
            "Make its boxes smaller or fewer, or their weights less.",
        )
    return CompiledCascade(cascade, voxel, gate, votes, stages, judge, largest)


def _box_table(boxes: list[list[int]]) -> I32:
    return np.array(boxes, dtype=np.int32).reshape(-1, 6)


def _rounded(value: float) -> float:
    """Take away what binary fractions add: 0.1 * 30 is not 3."""
    return round(value, 6) if math.isfinite(value) else value


def _floor(value: float) -> int:
    return math.floor(min(max(value, -(2.0**40)), 2.0**40))


def _compile_gate(cascade: Cascade, voxel: float, unit: int) -> CompiledGate:
    boxes: list[list[int]] = []
    weights: list[int] = []
    start, ranks, lows, highs = [0], [], [], []
    for condition in cascade.conditions:
        mine = [voxel_box(box, voxel) for box in condition.group.boxes]
        mine_weights = [box.weight for box in condition.group.boxes]
        pairs = zip(mine, mine_weights, strict=True)
        size: float = sum(w * volume(_box_table([box])) for box, w in pairs if w > 0) * unit
        if condition.rank:
            size /= len(mine)
        boxes += mine
        weights += mine_weights
        start.append(len(boxes))
        ranks.append(condition.rank)
        lows.append(-_floor(-_rounded(condition.minimum * size)))
        highs.append(_floor(_rounded(condition.maximum * size)))
    return CompiledGate(
        _box_table(boxes),
        np.array(weights, dtype=np.int32),
        np.array(start, dtype=np.int32),
        np.array(ranks, dtype=np.int32),
        np.array(lows, dtype=np.int64),
        np.array(highs, dtype=np.int64),
        cascade.spacing,
    )


def _compile_votes(votes: Votes, voxel: float) -> CompiledVotes:
    boxes: list[list[int]] = []
    weights: list[int] = []
    start = [0]
    yaws = np.radians(np.array(votes.yaws_deg))
    pairs = []
    for yaw in yaws:
        for mask in votes.masks:
            boxes += [voxel_box(turned(box, yaw), voxel) for box in mask.boxes]
            weights += [box.weight for box in mask.boxes]
            start.append(len(boxes))
        pairs.append([[voxel_box(turned(box, yaw), voxel) for box in pair] for pair in votes.mirrored])
    return CompiledVotes(
        _box_table(boxes),
        np.array(weights, dtype=np.int32),
        np.array(start, dtype=np.int32),
        len(votes.masks),
        np.array(pairs, dtype=np.int32).reshape(len(yaws), -1, 2, 6),
        yaws,
        votes.asymmetry_cost,
        votes.min_votes,
    )


def _compile_stages(cascade: Cascade, stages: tuple[Stage, ...], voxel: float, unit: int) -> CompiledStages:
    groups = _groups_by_first_use(cascade.groups, stages)
    index = {group.name: g for g, (group, _) in enumerate(groups)}
    sizes: dict[str, float] = {}
    boxes: list[list[int]] = []
    group_start = [0]
    for group, _ in groups:
        mine = [voxel_box(box, voxel) for box in group.boxes]
        boxes += mine
        group_start.append(len(boxes))
        cells = volume(_box_table(mine)) * (unit if group.channel == "occupied" else 1)
        for statistic in statistics(group):
            sizes[f"{group.name}.{statistic}"] = cells if statistic == "sum" else cells / len(mine)

    seen = [
        voxel_box(box, voxel) for group, _ in groups if group.channel != "occupied" for box in group.boxes
    ]
    if volume(_box_table(seen)) > MAX_SEEN_CELLS:
        raise HeadvoxError(
            f'Cascade {cascade.name}: its "empty" and "hidden" boxes have {volume(_box_table(seen))} cells of '
            f"{voxel:g} m, more than {MAX_SEEN_CELLS}.",
            "Make them smaller or fewer, or the voxels larger.",
        )

    nodes: list[int] = []

    def add(tree: Tree) -> tuple[int, int]:
        """Add a tree; return where its first node begins, and how deep it is."""
        at = len(nodes)
        if not isinstance(tree, tuple):
            nodes.extend([0, round(tree * SCORE_UNIT), at, at])
            return at, 0
        name, share, below, above = tree
        group, _, statistic = name.rpartition(".")
        feature = len(STATISTICS) * index[group] + STATISTICS.index(statistic)
        nodes.extend([feature, _floor(round(share * sizes[name], 6)), 0, 0])
        (nodes[at + 2], left), (nodes[at + 3], right) = add(below), add(above)
        return at, 1 + max(left, right)

    roots: list[tuple[int, int]] = []
    stage_trees = [0]
    for stage in stages:
        roots += [add(tree) for tree in stage.trees]
        stage_trees.append(len(roots))
    channel = [CHANNELS.index(group.channel) for group, _ in groups]
    first = [stage for _, stage in groups]
    count = len(stages)
    seeing = [stage for (group, stage) in groups if group.channel != "occupied"]
    return CompiledStages(
        _box_table(boxes),
        np.array(group_start, dtype=np.int32),
        np.array(channel, dtype=np.int32),
        np.array(nodes, dtype=np.int64),
        np.array([root for root, _ in roots], dtype=np.int64),
        np.array([depth for _, depth in roots], dtype=np.int32),
        np.array([0, *(sum(f <= s for f in first) for s in range(count))], dtype=np.int32),
        np.array(stage_trees, dtype=np.int32),
        np.array([-_floor(-stage.keep * SCORE_UNIT) for stage in stages], dtype=np.int64),
        min(seeing, default=count),
    )


def _groups_by_first_use(groups: tuple[Group, ...], stages: tuple[Stage, ...]) -> list[tuple[Group, int]]:
    """Return the groups that some tree asks for, in the order of the first stage that does, with that stage."""
    first: dict[str, int] = {}
    for s, stage in enumerate(stages):
        for tree in stage.trees:
            for name, _ in cuts(tree):
                first.setdefault(name.rpartition(".")[0], s)
    used = [(group, first[group.name]) for group in groups if group.name in first]
    return sorted(used, key=lambda pair: pair[1])
