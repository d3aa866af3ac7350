"""Fit the default cascade by boosting on synthetic scenes.

    pip install -e . lightgbm
    python tools/fit_cascade.py --views 4650 --rounds 3 -o default.toml

Scenes, whole bodies and head shells come from headvox.synth; every tenth is kept aside and reported on. Each round
looks at every voxel that passes the gate and keeps those about true heads, all that the last round's cascade was
wrong about, and a few others. Stages are boosted one after the other over a few groups of boxes each, chosen by gain
per box; then each stage's threshold is set to what the whole cascade accepts in the end (multiple-instance pruning,
Zhang and Viola, 2007). LightGBM only searches: what it finds is written as a text file of boxes, cuts and weights.

The thresholds that this writes are those of synthetic scenes. The shipped file's were then set on real frames that its
``tuned_on`` names: the lowest with at most 0.05 false heads a frame.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import lightgbm
import numpy as np

from headvox.data import Cloud, Frame
from headvox.fuse import Region
from headvox.gate import pass_gate
from headvox.integral import integral_volume
from headvox.kernels import kernel
from headvox.masks import (
    CHANNELS,
    STATISTICS,
    Box,
    Cascade,
    Condition,
    Group,
    compile_cascade,
    load_cascade,
    ring,
    statistics,
    voxel_box,
)
from headvox.mesh import sample_surface
from headvox.sources import open_source
from headvox.synth.heads import make_heads
from headvox.synth.people import pose_person, sample_person, sample_pose
from headvox.synth.scene import training_view
from headvox.visibility import count_seen
from headvox.vote import score_by_stages, sum_about
from headvox.voxelize import Lattice, voxelize_depth, voxelize_points

VOXEL_M, SUBDIVISION, RANGE_M = 0.05, 2, 5.0
NEAR_M = 0.87 * VOXEL_M  # half the diagonal of a voxel: every head has at least one
APART_M, HIDDEN_APART_M = 0.13, 0.25  # what is nearer to a head is neither it nor not it
LEAST_VISIBLE = 0.25
HARD, EASY = 400, 100  # negatives a view, at most
RANDOM = 1


# ------------------------------------------------------------------------------------------------ what can be asked


def cube(edge: float) -> tuple[float, float, float]:
    return (edge, edge, edge)


def slab(width: float, height: float, thick: float, weight: int = 1) -> Box:
    return Box((0.0, 0.0, height), (width, width, thick), weight)


GATE = tuple(
    Condition(Group(name, boxes), 0, low, high)
    for name, boxes, low, high in (
        ("crown", (slab(0.25, 0.05, 0.10),), 0.022, math.inf),
        ("beside", (slab(0.45, 0.05, 0.10), slab(0.25, 0.05, 0.10, -2)), -math.inf, 0.0193),
        ("cap", (slab(0.35, 0.15, 0.10), slab(0.35, 0.05, 0.10, -1)), -math.inf, -0.0127),
        ("top", (slab(0.15, 0.25, 0.10),), -math.inf, 0.035),
        ("above", (slab(0.25, 0.30, 0.25),), -math.inf, 0.07),
        ("brow", (slab(0.25, 0.15, 0.10), slab(0.15, 0.15, 0.10, -2)), -math.inf, 0.04),
        ("middle", (slab(0.15, 0.05, 0.10),), 0.0069, math.inf),
        ("shell", (slab(0.25, 0.0, 0.25),), 0.018, 0.75),
        ("below", (slab(0.35, -0.05, 0.10),), 0.003, math.inf),
    )
)


def one_box(name: str, box: Box) -> Group:
    return Group(f"{name}_{round(box.centre[2] * 100):+d}".replace("__", "_"), (box,))


def occupied_groups() -> list[Group]:
    """Return boxes on the axis, rings about it, and shells of boxes about the candidate."""
    groups = []
    for radius, edge, heights in (
        (0.10, 0.10, np.arange(-0.20, 0.21, 0.05)),
        (0.15, 0.10, np.arange(-0.30, 0.21, 0.10)),
        (0.20, 0.15, np.arange(-0.45, 0.26, 0.10)),
        (0.30, 0.15, np.arange(-0.45, 0.16, 0.15)),
        (0.40, 0.20, np.arange(-0.40, 0.21, 0.20)),
        (0.05, 0.05, np.arange(-0.10, 0.16, 0.05)),
        (0.10, 0.05, np.arange(-0.10, 0.16, 0.05)),
        (0.15, 0.05, np.arange(-0.10, 0.16, 0.05)),
    ):
        for height in heights.round(2):
            kind = "fine" if edge == 0.05 else "ring"
            name = f"{kind}{round(radius * 100)}_{round(height * 100):+d}"
            groups.append(Group(name, ring(radius, float(height), cube(edge))))
    for edge, heights in ((0.10, np.arange(-0.45, 0.31, 0.05)), (0.25, np.arange(-0.45, 0.31, 0.15))):
        groups += [
            one_box(f"axis{round(edge * 100)}", Box((0, 0, float(h)), cube(edge))) for h in heights.round(2)
        ]
    for width in (0.15, 0.25, 0.35, 0.45, 0.65):
        heights = np.arange(-0.45, 0.36, 0.10).round(2)
        groups += [one_box(f"slab{round(width * 100)}", slab(width, float(h), 0.10)) for h in heights]
    groups += [Group(f"cube{round(e * 100)}", (Box((0, 0, 0), cube(e)),)) for e in (0.05, 0.15, 0.35, 0.45)]
    for out, thick in ((0.10, 0.05), (0.15, 0.05), (0.20, 0.10), (0.30, 0.10)):
        faces = tuple(_face(axis, sign, out, thick) for axis in range(3) for sign in (-1, 1))
        groups.append(Group(f"six{round(out * 100)}", faces))
    for out, edge in ((0.075, 0.15), (0.125, 0.15), (0.20, 0.20)):
        corners = [(out * a, out * b, out * c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
        groups.append(
            Group(f"eight{round(out * 1000)}", tuple(Box(corner, cube(edge)) for corner in corners))
        )
    return groups


def _face(axis: int, sign: int, out: float, thick: float) -> Box:
    centre = [0.0, 0.0, 0.0]
    centre[axis] = sign * out
    size = [2 * out - thick] * 3
    size[axis] = thick
    return Box((centre[0], centre[1], centre[2]), (size[0], size[1], size[2]))


def seen_groups() -> list[Group]:
    """Return boxes on the axis and rings of small boxes, in the channels "empty" and "hidden"."""
    groups = []
    for channel in CHANNELS[1:]:
        for height in (-0.30, -0.15, 0.0, 0.15, 0.25, 0.40):
            box = Box((0, 0, height), cube(0.15))
            groups.append(replace(one_box(f"{channel}axis_", box), channel=channel))
        for radius, heights in (
            (0.10, (-0.10, 0.0, 0.10)),
            (0.15, (-0.20, -0.10, 0.05, 0.20)),
            (0.25, (-0.40, -0.20, 0.0, 0.10, 0.25)),
            (0.40, (-0.30, 0.0, 0.15)),
        ):
            for height in heights:
                name = f"{channel}{round(radius * 100)}_{round(height * 100):+d}"
                groups.append(Group(name, ring(radius, height, cube(0.10)), channel))
    return groups


@dataclass(frozen=True)
class Bank:
    """Groups of boxes in voxels, and the names and volumes of their statistics."""

    groups: list[Group]

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return boxes (B, 6) and where each group's begin (G + 1,)."""
        boxes = [[voxel_box(box, VOXEL_M) for box in group.boxes] for group in self.groups]
        start = np.cumsum([0, *map(len, boxes)]).astype(np.int32)
        return np.array([box for group in boxes for box in group], np.int32), start

    def names(self) -> list[str]:
        return [f"{group.name}.{statistic}" for group in self.groups for statistic in statistics(group)]

    def volumes(self) -> dict[str, float]:
        """Return what a share of 1 of each statistic is: parts, or cells in the channels that were seen."""
        volumes = {}
        for group in self.groups:
            boxes = np.array([voxel_box(box, VOXEL_M) for box in group.boxes])
            cells = int(np.prod(boxes[:, 1::2] - boxes[:, 0::2], axis=1).sum())
            cells *= SUBDIVISION**3 if group.channel == "occupied" else 1
            for statistic in statistics(group):
                volumes[f"{group.name}.{statistic}"] = cells if statistic == "sum" else cells / len(boxes)
        return volumes

    def features(self, sums: np.ndarray) -> np.ndarray:
        """Return the statistics (N, F) of the boxes' ``sums`` (N, B)."""
        _, start = self.boxes()
        columns = []
        for group, a, b in zip(self.groups, start[:-1], start[1:], strict=True):
            part = np.sort(sums[:, a:b], axis=1)
            if len(statistics(group)) > 1:
                columns += [part[:, 0], part[:, 2], part[:, -3], part[:, -1]]
            columns.append(part.sum(axis=1))
        return np.stack(columns, axis=1).astype(np.int16)


OCCUPIED, SEEN = Bank(occupied_groups()), Bank(seen_groups())
assert STATISTICS[-1] == "sum"


@kernel
def occupied_sums(S, cells, boxes, out):  # type: ignore[no-untyped-def]
    for i in range(cells.shape[0]):
        for b in range(boxes.shape[0]):
            out[i, b] = sum_about(S, cells[i, 0], cells[i, 1], cells[i, 2], boxes[b])


# --------------------------------------------------------------------------------------------------------- samples


@dataclass(frozen=True)
class TrueHead:
    centre: np.ndarray
    clear: bool


def frames(views: int, bodies: int, shells: int, heads: Path) -> Iterator[tuple[int, Frame, list[TrueHead]]]:
    """Yield seed, frame and heads of scenes, of whole bodies scanned from all around, and of lone head shells."""
    for seed in range(10_000, 10_000 + views):
        frame, truth = training_view(seed)
        yield seed, frame, [TrueHead(t.centre, _is_clear(t, frame)) for t in truth]
    for seed in range(20_000, 20_000 + bodies):
        yield seed, *_bodies(np.random.default_rng(seed))
    clouds = [next(iter(open_source(heads / f"head_{k:02d}.ply"))).clouds[0].points for k in range(30)]
    for seed in range(21_000, 21_000 + shells):
        yield seed, *_shell(np.random.default_rng(seed), clouds)


def _is_clear(truth: object, frame: Frame) -> bool:
    seen = max(truth.visible.values(), default=1.0) >= LEAST_VISIBLE  # type: ignore[attr-defined]
    near = np.linalg.norm(truth.centre - _centre(frame)) < RANGE_M - 0.2  # type: ignore[attr-defined]
    return bool(seen and near and not truth.ignore and not truth.truncated)  # type: ignore[attr-defined]


def _bodies(rng: np.random.Generator) -> tuple[Frame, list[TrueHead]]:
    postures = [
        "standing",
        "walking",
        "sitting",
        "bending",
        "bending",
        "bending",
        "crouching",
        "lying",
        "arms_raised",
    ]
    parts, heads = [], []
    for x, y in [(-1.6, -1.2), (1.5, -1.0), (0.0, 1.6)][: rng.integers(1, 4)]:
        pose = sample_pose(rng, postures[rng.integers(len(postures))])
        body = pose_person(sample_person(rng), pose, (x, y), rng.uniform(0, 2 * np.pi))
        parts.append(sample_surface(body.vertices, body.faces, float(rng.uniform(0.008, 0.02))))
        heads.append(TrueHead(body.T_world_head[:3, 3], True))
    if rng.random() < 0.5:
        floor = np.stack(np.meshgrid(np.arange(-3, 3, 0.02), np.arange(-3, 3, 0.02)), -1).reshape(-1, 2)
        parts.append(np.column_stack([floor, np.zeros(len(floor))]))
    points = np.concatenate(parts) + rng.normal(0, rng.choice([0.0, 0.003]), (sum(map(len, parts)), 3))
    return Frame(0, clouds=(Cloud("bodies", np.ascontiguousarray(points, np.float32)),)), heads


def _shell(rng: np.random.Generator, clouds: list[np.ndarray]) -> tuple[Frame, list[TrueHead]]:
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    at = rng.uniform([-1, -1, 0], [1, 1, 1.8]) if rng.random() < 0.7 else rng.normal(0, 0.03, 3)
    points = clouds[rng.integers(len(clouds))] @ turn.T + at
    return Frame(0, clouds=(Cloud("shell", np.ascontiguousarray(points, np.float32)),)), [TrueHead(at, True)]


def _centre(frame: Frame) -> np.ndarray:
    placed = [image.T_world_camera for image in frame.depths]
    placed += [cloud.T_world_sensor for cloud in frame.clouds if cloud.T_world_sensor is not None]
    return np.mean([T[:3, 3] for T in placed], axis=0) if placed else np.zeros(3)


@dataclass(frozen=True)
class Samples:
    """Candidates: features, 1 for a head and 0 for none, whose head, the view they are from, whether cameras saw it."""

    features: np.ndarray
    label: np.ndarray
    head: np.ndarray
    view: np.ndarray
    seen: np.ndarray

    @property
    def aside(self) -> np.ndarray:
        return self.view % 10 == 0


def collect(
    source: Callable[[], Iterator[tuple[int, Frame, list[TrueHead]]]], miner: Cascade | None
) -> Samples:
    """Return the candidates of all frames that a round learns from."""
    gate = compile_cascade(
        Cascade("gate", "gate", VOXEL_M, SUBDIVISION, False, GATE, None, (), (), 0, 0, ())
    ).gate
    stages = compile_cascade(miner).stages if miner else None
    occupied, _ = OCCUPIED.boxes()
    seen_boxes, _ = SEEN.boxes()
    seen_channel = np.array([CHANNELS.index(g.channel) - 1 for g in SEEN.groups for _ in g.boxes])
    parts, lost, heads = [], 0, 0
    for seed, frame, truth in source():
        lattice = Lattice.over(Region(tuple(_centre(frame)), RANGE_M, -0.5, 2.5), VOXEL_M, SUBDIVISION)
        grid = np.zeros(lattice.shape, np.uint8)
        for image in frame.depths:
            grid |= voxelize_depth(image, lattice)
        for cloud in frame.clouds:
            grid |= voxelize_points(cloud, lattice)
        S = integral_volume(grid)
        cells = pass_gate(S, gate)
        if not len(cells):
            continue
        middles, label, owner = lattice.centres(cells), np.zeros(len(cells), np.int8), np.full(len(cells), -1)
        far = [np.linalg.norm(middles - head.centre, axis=1) for head in truth]
        for distance, head in zip(far, truth, strict=True):
            label[distance < (APART_M if head.clear else HIDDEN_APART_M)] = -1
        for k, (distance, head) in enumerate(zip(far, truth, strict=True)):
            if head.clear:
                label[distance <= NEAR_M], owner[distance <= NEAR_M] = 1, 10 * seed + k
                heads, lost = heads + 1, lost + (not (distance <= NEAR_M).any())
        score = score_by_stages(S, cells, stages) if stages else np.zeros(len(cells))
        wrong = np.flatnonzero((label == 0) & (score > score.min()))
        right = np.flatnonzero((label == 0) & (score == score.min()))
        rng = np.random.default_rng(seed)
        few = [
            rng.choice(some, min(most, len(some)), replace=False)
            for some, most in ((wrong, HARD), (right, EASY))
        ]
        chosen = np.concatenate([np.flatnonzero(label == 1), *few])
        sums = np.empty((len(chosen), len(occupied)), np.int32)
        occupied_sums(S, cells[chosen], occupied, sums)
        sees = bool(frame.depths) and not frame.clouds
        found = np.full((len(chosen), len(seen_boxes)), 0, np.int32)
        if sees:
            counts = count_seen(frame.depths, lattice, cells[chosen], seen_boxes)
            found = counts[:, np.arange(len(seen_boxes)), seen_channel]
        features = np.concatenate([OCCUPIED.features(sums), SEEN.features(found)], axis=1)
        parts.append(
            (features, label[chosen], owner[chosen], np.full(len(chosen), seed), np.full(len(chosen), sees))
        )
    print(f"{heads} heads, {lost} lost at the gate", flush=True)
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


# -------------------------------------------------------------------------------------------------------- boosting


@dataclass
class Fitted:
    """A stage: its threshold, its model, the features it uses, and every sample's score up to it."""

    name: str
    keep: float
    model: lightgbm.Booster
    names: list[str]
    score: np.ndarray


# name, groups to choose from, how many more, trees, learning rate, heads it may lose before pruning
PLAN = (
    ("glimpse", "single", 4, 5, 0.40, 0.001),
    ("glance", "single", 4, 7, 0.40, 0.001),
    ("look", "single", 6, 12, 0.30, 0.002),
    ("outline", "occupied", 5, 20, 0.25, 0.003),
    ("shape", "occupied", 8, 40, 0.15, 0.004),
    ("detail", "occupied", 14, 120, 0.12, 0.006),
    ("sight", "seen", 12, 160, 0.10, 0.0),
)


def boost(samples: Samples) -> list[Fitted]:
    """Fit one stage after the other, each on what the ones before it let through."""
    names = np.array(OCCUPIED.names() + SEEN.names())
    group = np.array([name.rpartition(".")[0] for name in names])
    boxes = {g.name: len(g.boxes) for g in OCCUPIED.groups + SEEN.groups}
    seen = np.isin(group, [g.name for g in SEEN.groups])
    pools = {"single": np.array([boxes[g] == 1 for g in group]) & ~seen, "occupied": ~seen, "seen": seen}
    rows, score, have, fitted = np.ones(len(samples.label), bool), None, [], []
    for name, pool, more, trees, rate, lose in PLAN:
        rows = rows & samples.seen if pool == "seen" else rows
        model, _ = _fit(samples, np.flatnonzero(pools[pool]), rows, score, 20, 0.2, 0.5)
        gain = Counter()
        for column, value in zip(np.flatnonzero(pools[pool]), model.feature_importance("gain"), strict=True):
            gain[str(group[column])] += value / (boxes[str(group[column])] + 2)
        have = have + [g for g, _ in gain.most_common() if g not in have][:more]
        allowed = pools[pool] | pools["occupied"] if pool == "seen" else pools[pool]
        columns = np.flatnonzero(np.isin(group, have) & allowed)
        model, score = _fit(samples, columns, rows, score, trees, rate, 1.0 if trees < 40 else 0.6)
        keep = of_heads(samples, score, ~samples.aside & rows, lose)
        fitted.append(Fitted(name, keep, model, list(names[columns]), score))
        _report(name, samples, score)
        rows = rows & (score >= keep)
    return fitted


def _fit(samples, columns, rows, start, trees, rate, share):  # type: ignore[no-untyped-def]
    learn = rows & ~samples.aside
    data = lightgbm.Dataset(
        samples.features[learn][:, columns].astype(np.float32),
        samples.label[learn],
        init_score=None if start is None else start[learn],
        weight=np.where(samples.label[learn] == 1, 3.0, 1.0),
    )
    settings = {
        "objective": "binary", "num_leaves": 8, "max_depth": 4, "learning_rate": rate, "min_data_in_leaf": 30,
        "feature_fraction": share, "bagging_fraction": 0.8, "bagging_freq": 1, "lambda_l2": 3.0, "seed": RANDOM,
        "deterministic": True, "force_row_wise": True, "num_threads": 2, "verbose": -1,
    }  # fmt: skip
    model = lightgbm.train(settings, data, trees)
    score = np.full(len(rows), -1e3)
    score[rows] = model.predict(samples.features[rows][:, columns].astype(np.float32), raw_score=True)
    if start is not None:
        score[rows] += start[rows]
    return model, score


def best_of_heads(samples: Samples, score: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the best score of each head."""
    best: dict[int, float] = {}
    mine = rows & (samples.label == 1)
    for head, value in zip(samples.head[mine], score[mine], strict=True):
        best[head] = max(best.get(head, -1e3), value)
    return np.array(list(best.values()))


def of_heads(samples: Samples, score: np.ndarray, rows: np.ndarray, share: float) -> float:
    """Return the score that this share of the heads stays below."""
    return float(np.quantile(best_of_heads(samples, score, rows), share))


def _report(name: str, samples: Samples, score: np.ndarray) -> None:
    aside = samples.aside & samples.seen
    views = len(np.unique(samples.view[aside]))
    wrong = score[aside & (samples.label == 0)]
    rates = [
        (1 - q, (wrong > of_heads(samples, score, aside, q)).sum() / views) for q in (0.01, 0.02, 0.05, 0.1)
    ]
    print(
        f"{name:8s}", " | ".join(f"recall {r:.2f}: {f:.2f} wrong voxels a view" for r, f in rates), flush=True
    )


def prune(fitted: list[Fitted], samples: Samples) -> tuple[float, float]:
    """Raise each stage's threshold to what the whole accepts; return the final thresholds, with depth and without."""
    learn = ~samples.aside & (samples.label == 1)
    final, occupied = fitted[-1].score, fitted[-2].score
    least = of_heads(samples, final, ~samples.aside & samples.seen, 0.06)
    least_occupied = of_heads(samples, occupied, ~samples.aside & ~samples.seen, 0.02)
    accepted = learn & np.where(samples.seen, final >= least, occupied >= least_occupied)
    for stage in fitted[:-1]:
        stage.keep = max(stage.keep, of_heads(samples, stage.score, accepted, 0.004))
    return least, least_occupied


# --------------------------------------------------------------------------------------------------------- writing


def write(path: Path, fitted: list[Fitted], least: float, least_occupied: float, tuned_on: list[str]) -> None:
    """Write the cascade as TOML."""
    volumes = {**OCCUPIED.volumes(), **SEEN.volumes()}
    lines = [
        "# A gate of signed boxes, then a boosted sum of look-ups over sorted rings of boxes.",
        "# Shares are filled parts over all parts of a box (occupied), or cells over all cells (empty, hidden).",
        "# A tree is [feature, cut, at most the cut, above it]; the leaves that are reached are added up.",
        "",
        'format = "headvox-cascade"', "version = 1", 'name = "default"',
        f'summary = "Boosted on synthetic depth: {len(GATE)} signed gate masks, then {len(fitted)} stages of trees"',
        f"voxel_m = {VOXEL_M}", f"subdivision = {SUBDIVISION}", 'occupancy = "parts"', 'candidates = "every other"',
        f"min_score = {least:.2f}", f"min_score_occupied = {least_occupied:.2f}",
        f"tuned_on = [{', '.join(repr(entry).replace(chr(39), chr(34)) for entry in tuned_on)}]", "",
    ]  # fmt: skip
    for condition in GATE:
        lines += ["[[gate]]", f'name = "{condition.group.name}"', _boxes(condition.group)]
        lines += [f"min = {condition.minimum:g}"] if math.isfinite(condition.minimum) else []
        lines += [f"max = {condition.maximum:g}"] if math.isfinite(condition.maximum) else []
        lines.append("")
    trees = [
        [_tree(t["tree_structure"], s.names, volumes) for t in s.model.dump_model()["tree_info"]]
        for s in fitted
    ]
    text = "\n".join(tree for stage in trees for tree in stage)
    for group in OCCUPIED.groups + SEEN.groups:
        if f'"{group.name}.' in text:
            channel = [f'channel = "{group.channel}"'] if group.channel != "occupied" else []
            lines += ["[[group]]", f'name = "{group.name}"', *channel, _boxes(group), ""]
    for stage, its_trees in zip(fitted, trees, strict=True):
        keep = [f"keep = {math.floor(stage.keep * 100) / 100:g}"] if stage is not fitted[-1] else []
        lines += [
            "[[stage]]",
            f'name = "{stage.name}"',
            *keep,
            "trees = [",
            *(f"  {t}," for t in its_trees),
            "]",
            "",
        ]
    path.write_text("\n".join(lines), encoding="utf-8")


def _numbers(values: tuple[float, ...]) -> str:
    return f"[{', '.join(f'{value:.6g}' for value in values)}]"


def _boxes(group: Group) -> str:
    first = group.boxes[0]
    if len(group.boxes) == 8 and first.centre[0] > 0 and abs(first.centre[1]) < 1e-9:
        return f"ring = {{ radius = {first.centre[0]:g}, height = {first.centre[2]:g}, size = {_numbers(first.size)} }}"
    weights = ["" if box.weight == 1 else f", weight = {box.weight}" for box in group.boxes]
    entries = [
        f"{{ centre = {_numbers(box.centre)}, size = {_numbers(box.size)}{weight} }}"
        for box, weight in zip(group.boxes, weights, strict=True)
    ]
    return f"boxes = [{', '.join(entries)}]"


def _tree(node: dict, names: list[str], volumes: dict[str, float]) -> str:  # type: ignore[type-arg]
    if "leaf_value" in node:
        return f"{round(node['leaf_value'], 3) + 0.0:g}"
    name = names[node["split_feature"]]
    share = (math.floor(node["threshold"]) + 0.5) / volumes[name]
    below, above = (_tree(node[side], names, volumes) for side in ("left_child", "right_child"))
    return f'["{name}", {share:.5g}, {below}, {above}]'


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, default=4650)
    parser.add_argument("--bodies", type=int, default=350)
    parser.add_argument("--shells", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    heads = args.out.with_suffix(".heads")
    make_heads(heads, count=44, points=9000, metric=False, seed=0, workers=1)
    samples, miner = None, None
    for number in range(1, args.rounds + 1):
        print(f"round {number}", flush=True)
        new = collect(lambda: frames(args.views, args.bodies, args.shells, heads), miner)
        samples = new if samples is None else _join(samples, new)
        fitted = boost(samples)
        least, least_occupied = prune(fitted, samples)
        given = f"{args.views} views, {args.bodies} bodies, {args.shells} shells"
        tuned_on = [f"boosting: synthetic, {given}, but every tenth"]
        write(args.out, fitted, least, least_occupied, tuned_on)
        miner = load_cascade(args.out)


def _join(old: Samples, new: Samples) -> Samples:
    """Add the new negatives to what there is; the heads are the same."""
    add = new.label == 0
    pairs = ((getattr(old, name), getattr(new, name)[add]) for name in Samples.__dataclass_fields__)
    return replace(old, **dict(zip(Samples.__dataclass_fields__, map(np.concatenate, pairs), strict=True)))


if __name__ == "__main__":
    main()
