"""Reads a cascade from its TOML file, which may come from anywhere: every error names the file and the entry."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any

from headvox.errors import HeadvoxError
from headvox.masks.cascade import (
    CHANNELS,
    MEASURES,
    SIDES,
    Box,
    Cascade,
    Condition,
    Group,
    Mask,
    Relief,
    Spot,
    Stage,
    Tree,
    Verification,
    Votes,
    cuts,
    ring,
    statistics,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

FORMAT = "headvox-cascade"
SPACINGS = {"all": 1, "every other": 2, "every fourth": 4}
MAX_FILE_BYTES = 8 << 20
MAX_EXTENT_M = 2.0
MOST_SPOTS = 256
DEEPEST_TREE = 30
LARGEST = 1e9  # of shares and scores: their sums stay far within 64 bits


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
        text = path.read_text("utf-8-sig")  # editors of Windows may begin it with a BOM
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


def _as_number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


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
        if type(value) is float and low <= value <= high:  # as nearly always, of 100,000 and more
            return value
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
        if isinstance(value, str) and depth == 0:
            return self.tree_of_words(iter(value.split()), features, where)
        if not isinstance(value, list):
            return self.number(value, where, -1000.0, 1000.0)
        if len(value) != 4 or depth > DEEPEST_TREE:
            raise self.error(where, f"[feature, cut, at most, above], {DEEPEST_TREE} deep at most", value)
        feature, cut, *branches = value
        below, above = (self.tree(branch, features, where, depth + 1) for branch in branches)
        return self.feature(feature, features, where), self.number(cut, where), below, above

    def tree_of_words(self, words: Iterator[str], features: set[str], where: str) -> Tree:
        """Return a tree in prefix notation: a feature, its cut, the branch at most the cut, that above; or a leaf.

        A megabyte of it loads in less than a third of the time that the same trees take as nested lists.
        """
        tree = self.branch(words, features, where, 0)
        more = next(words, None)
        if more is not None:
            raise self.error(where, "one tree in a text", more)
        return tree

    def branch(self, words: Iterator[str], features: set[str], where: str, depth: int) -> Tree:
        word = next(words, "")
        if word in features and depth <= DEEPEST_TREE:
            cut = self.number(_as_number(next(words, "")), where)
            below = self.branch(words, features, where, depth + 1)
            return word, cut, below, self.branch(words, features, where, depth + 1)
        leaf = _as_number(word)
        if isinstance(leaf, str):
            raise self.error(where, f"a leaf, or a feature of this file, {DEEPEST_TREE} deep at most", leaf)
        return self.number(leaf, where, -1000.0, 1000.0)

    def feature(self, value: object, features: set[str], where: str) -> str:
        name = self.text(value, where)
        if name not in features:
            raise self.error(
                where, "a statistic of a group, a side of a spot of this file, or a measure", name
            )
        return name

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

    def relief(self, value: object) -> Relief:
        table = self.table(value, "relief", {"most", "first", "reach", "spots", "trees"})
        spots = []
        named = table.get("spots")
        for name, place in named.items() if isinstance(named, dict) else ():
            where = f"relief.spots.{name}"
            if len(self.items(place, where)) != 2:
                raise self.error(where, "two numbers: to the side, and up", place)
            side, up = (self.number(v, where, -MAX_EXTENT_M, MAX_EXTENT_M) for v in place)
            spots.append(Spot(name, side, up))
        if not 1 <= len(spots) <= MOST_SPOTS:
            raise self.error("relief.spots", f"a table of 1 to {MOST_SPOTS} spots", named)
        features = {f"{spot.name}.{side}" for spot in spots for side in SIDES} | set(MEASURES)
        trees = self.items(table.get("trees"), "relief.trees")
        most = self.number(table.get("most"), "relief.most", 0.0, 1000.0)
        return Relief(
            most,
            tuple(spots),
            tuple(self.tree(tree, features, "relief.trees") for tree in trees),
            self.whole(table.get("first", 0), "relief.first", 0, len(trees)),
            self.number(table.get("reach", math.inf), "relief.reach", 0.0, math.inf),
        )

    def verification(self, value: object) -> Verification:
        names = [entry.name for entry in fields(Verification)]
        table = self.table(value, "verification", set(names))
        return Verification(*(self.number(table.get(name), f"verification.{name}", 0.0) for name in names))

    def cascade(self, value: dict[str, Any]) -> Cascade:
        known = {"format", "version", "name", "summary", "voxel_m", "subdivision", "occupancy", "gate"}
        known |= {
            "votes",
            "group",
            "stage",
            "min_score",
            "min_score_occupied",
            "tuned_on",
            "candidates",
            "relief",
            "verification",
        }
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
            relief=self.relief(table["relief"]) if "relief" in table else None,
            verification=self.verification(table["verification"]) if "verification" in table else None,
        )
