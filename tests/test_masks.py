import copy
from dataclasses import replace
from importlib import resources

import naive_voxels
import numpy as np
import pytest
import scenes
import tomllib
from hypothesis import given, settings
from hypothesis import strategies as st

from headvox.errors import HeadvoxError
from headvox.integral import integral_volume
from headvox.masks import read as read_masks
from headvox.masks.cascade import Box, ring
from headvox.masks.compile import compile_cascade, voxel_box, voxel_range
from headvox.masks.read import load_cascade, parse_cascade, shipped_cascades

VOXELS = [k / 100 for k in range(1, 11)] + [0.025, 0.0125, 1 / 30]
STAGES, VOTES = tomllib.loads(scenes.STAGES), tomllib.loads(scenes.VOTES)


# ------------------------------------------------------------------------------------------------- metres to voxels


@given(st.sampled_from(VOXELS), st.integers(-400, 400), st.integers(1, 400))
@settings(max_examples=500, deadline=None, derandomize=True)
def test_ranges_equal_the_naive_twin(voxel, centre, size):
    """Centres and sizes in half centimetres."""
    c, s = centre * 0.005, size * 0.005
    assert voxel_range(c, s, voxel) == naive_voxels.voxel_range(c, s, voxel)


@pytest.mark.parametrize("voxel", VOXELS)
def test_ranges_mean_what_they_say(voxel):
    """As many voxels as the size is near to; the middle of them as near to the centre as can be."""
    for size in np.arange(0.005, 0.6, 0.005):
        for centre in np.arange(-0.6, 0.6, 0.0125):
            start, end = voxel_range(float(centre), float(size), voxel)
            count = end - start
            assert count >= 1
            assert abs(count - size / voxel) <= 0.5 + 1e-9 or count == 1
            middle = start + (count - 1) / 2
            assert abs(middle - centre / voxel) <= 0.5 + 1e-5


@pytest.mark.parametrize("voxel", VOXELS)
def test_mirrored_boxes_stay_mirrored(voxel):
    for size in np.arange(0.005, 0.5, 0.005):
        for centre in np.arange(0.0025, 0.5, 0.0025):
            start, end = voxel_range(float(centre), float(size), voxel)
            if round(float(centre) / voxel, 6) != 0:
                assert voxel_range(-float(centre), float(size), voxel) == (1 - end, 1 - start)
            if (end - start) % 2:
                a, b = voxel_range(0.0, float(size), voxel)
                assert (a, b) == (1 - b, 1 - a)


@pytest.mark.parametrize("voxel", VOXELS)
@pytest.mark.parametrize("count", [4, 8, 12, 16])
def test_rings_are_symmetric(voxel, count):
    """Mirrored in x, in y, and turned by a quarter, a ring of cubes is itself, at any voxel size."""
    for radius in (0.1, 0.175, 0.2, 0.25, 0.35):
        boxes = {
            tuple(voxel_box(box, voxel)) for box in ring(radius, 0.05, (3 * voxel, 3 * voxel, voxel), count)
        }
        assert len(boxes) == len(ring(radius, 0.05, (0.1, 0.1, 0.1), count)) or voxel > 0.03
        assert {(1 - b, 1 - a, *rest) for a, b, *rest in boxes} == boxes
        assert {(a, b, 1 - d, 1 - c, *rest) for a, b, c, d, *rest in boxes} == boxes
        assert {(c, d, a, b, *rest) for a, b, c, d, *rest in boxes} == boxes


def test_boxes_on_the_grid_are_exact():
    assert voxel_range(0.075, 0.025, 0.025) == (3, 4)
    assert voxel_range(-0.075, 0.075, 0.025) == (-4, -1)
    assert voxel_range(0.0, 0.0, 0.025) == (0, 1)
    assert voxel_box(Box((0.1, 0.0, -0.05), (0.05, 0.15, 0.1)), 0.05) == [2, 3, -1, 2, -2, 0]


# ------------------------------------------------------------------------------------------------ shipped cascades


@pytest.mark.parametrize("name", shipped_cascades())
@pytest.mark.parametrize("voxel", [None, 0.02, 0.025, 0.04, 0.05])
def test_shipped_cascades_compile_and_fit_their_type(name, voxel):
    cascade = load_cascade(name)
    compiled = compile_cascade(cascade, voxel)
    v = voxel or cascade.voxel_m
    assert compiled.voxel_m == v
    unit = 1 if cascade.counting else cascade.subdivision**3
    wanted = [box for c in cascade.conditions for box in c.group.boxes]
    assert compiled.gate.boxes.tolist() == [naive_voxels.voxel_box(box, v) for box in wanted]
    for condition in cascade.conditions:
        boxes = [naive_voxels.voxel_box(box, v) for box in condition.group.boxes]
        total = (
            sum(map(naive_voxels.volume, boxes))
            if condition.rank == 0
            else max(map(naive_voxels.volume, boxes))
        )
        assert total * unit <= compiled.largest_sum
    for table in (t.boxes for t in (compiled.stages, compiled.votes) if t is not None):
        assert max(map(naive_voxels.volume, table.tolist())) * unit <= compiled.largest_sum
    if compiled.votes is not None and compiled.votes.pairs.size:
        assert (
            max(map(naive_voxels.volume, compiled.votes.pairs.reshape(-1, 6).tolist())) * unit
            <= compiled.largest_sum
        )
    full = integral_volume(np.full((3, 3, 3), 1 if cascade.subdivision == 1 else 255, np.uint8))
    assert full[-1, -1, -1] == 27 * cascade.subdivision**3


@pytest.mark.parametrize("name", shipped_cascades())
def test_shipped_cascades_can_be_read_and_told_apart(name):
    cascade = load_cascade(name)
    assert cascade.name == name
    assert len(cascade.summary) > 10
    assert (cascade.votes is None) != (not cascade.stages)
    assert cascade.conditions


def test_the_gate_of_a_cropped_grid_needs_a_point_nearby():
    """The detector looks only near points: what passes a shipped gate must hold some."""
    for name in shipped_cascades():
        gate = compile_cascade(load_cascade(name)).gate
        assert gate.low.max() > 0


# ----------------------------------------------------------------------------------------------------------- errors


def write(table) -> str:
    """Return a table as TOML, tables inline."""

    def value(v):
        if isinstance(v, bool):
            return str(v).lower()
        if isinstance(v, str):
            return f'"{v}"'
        if isinstance(v, list):
            return f"[{', '.join(value(x) for x in v)}]"
        if isinstance(v, dict):
            return "{" + ", ".join(f"{k} = {value(x)}" for k, x in v.items()) + "}"
        return str(v)

    return "\n".join(f"{key} = {value(v)}" for key, v in table.items())


def changed(table, path, new):
    """Return a copy with the entry at ``path`` set to ``new``, or removed if that is None."""
    table = copy.deepcopy(table)
    at = table
    for key in path[:-1]:
        at = at[key]
    if new is None:
        del at[path[-1]]
    else:
        at[path[-1]] = new
    return table


def test_the_written_form_is_read_back():
    assert parse_cascade(write(STAGES), "x") == parse_cascade(scenes.STAGES, "x")
    assert parse_cascade(write(VOTES), "x") == parse_cascade(scenes.VOTES, "x")


NAN, INF = float("nan"), float("inf")
CUBE = {"centre": [0, 0, 0], "size": [0.1, 0.1, 0.1]}
WRONG = [
    (STAGES, ["format"], "mask", "format, version"),
    (STAGES, ["version"], 2, "format, version"),
    (STAGES, ["name"], None, "name: expected text"),
    (STAGES, ["name"], "", "name: expected text"),
    (STAGES, ["summary"], 3, "summary: expected text"),
    (STAGES, ["voxel_m"], None, "voxel_m: expected a number"),
    (STAGES, ["voxel_m"], 0.0, "voxel_m: expected a number from 0.005 to 0.2, got 0.0"),
    (STAGES, ["voxel_m"], "0.05", "voxel_m"),
    (STAGES, ["voxel_m"], True, "voxel_m"),
    (STAGES, ["voxel_m"], NAN, "voxel_m"),
    (STAGES, ["subdivision"], 3, "subdivision: expected a whole number from 1 to 2, got 3"),
    (STAGES, ["subdivision"], 2.0, "subdivision"),
    (STAGES, ["occupancy"], "bits", "occupancy"),
    (STAGES, ["occupancy"], "count", "subdivision"),  # a count grid has no parts
    (STAGES, ["min_score"], None, "min_score"),
    (STAGES, ["min_score"], INF, "min_score"),
    (STAGES, ["min_score"], NAN, "min_score"),
    (STAGES, ["min_score_occupied"], -INF, "min_score_occupied"),
    (STAGES, ["tuned_on"], "all", "tuned_on: expected a list"),
    (STAGES, ["tuned_on"], [1], "tuned_on: expected text"),
    (STAGES, ["colour"], "red", "got 'colour'"),
    (STAGES, ["gate"], {}, "gate: expected a list"),
    (STAGES, ["gate"], [], "gate: expected a condition with min above 0"),
    (
        STAGES,
        ["gate"],
        [{"name": "a", "boxes": [CUBE], "max": 0.1}],
        "gate: expected a condition with min above 0",
    ),
    (STAGES, ["gate", 0], 3, "gate: expected a table"),
    (STAGES, ["gate", 0, "name"], None, "gate.name: expected text"),
    (STAGES, ["gate", 0, "boxes"], None, "gate shell: expected either boxes or ring"),
    (STAGES, ["gate", 0, "boxes"], [], "gate shell: expected 1 to 64 boxes, got 0"),
    (STAGES, ["gate", 0, "boxes"], [CUBE] * 65, "gate shell: expected 1 to 64 boxes, got 65"),
    (STAGES, ["gate", 0, "boxes", 0, "centre"], [0, 0], "gate shell.boxes.centre: expected three numbers"),
    (STAGES, ["gate", 0, "boxes", 0, "centre"], [0, 0, 2.5], "gate shell.boxes.centre"),
    (STAGES, ["gate", 0, "boxes", 0, "size"], [0.1, 0.1, -0.1], "gate shell.boxes.size"),
    (STAGES, ["gate", 0, "boxes", 0, "size"], 0.1, "gate shell.boxes.size: expected a list"),
    (STAGES, ["gate", 0, "boxes", 0, "extent"], 0.1, "got 'extent'"),
    (STAGES, ["gate", 0, "boxes", 0, "weight"], -1, "gate shell: expected a box of positive weight"),
    (
        STAGES,
        ["gate", 2],
        {"name": "g", "boxes": [{**CUBE, "weight": 2}], "rank": 1},
        "gate g: expected no weights",
    ),
    (STAGES, ["gate", 0, "rank"], 2, "gate shell.rank: expected a whole number from 0 to 1, got 2"),
    (STAGES, ["gate", 2, "rank"], 9, "gate above.rank"),
    (STAGES, ["gate", 0, "rank"], -1, "gate shell.rank"),
    (STAGES, ["gate", 0, "min"], "much", "gate shell.min"),
    (STAGES, ["gate", 0, "min"], NAN, "gate shell.min"),
    (STAGES, ["gate", 0, "max"], NAN, "gate shell.max"),
    (STAGES, ["gate", 2, "ring", "radius"], None, "gate above.ring.radius"),
    (STAGES, ["gate", 2, "ring", "radius"], -0.1, "gate above.ring.radius"),
    (STAGES, ["gate", 2, "ring", "count"], 2, "gate above.ring.count"),
    (STAGES, ["gate", 2, "ring", "count"], 65, "gate above.ring.count"),
    (STAGES, ["gate", 2, "ring", "yaw"], 1, "got 'yaw'"),
    (STAGES, ["group", 0, "channel"], "full", "group near.channel: expected occupied or empty or hidden"),
    (STAGES, ["group", 3, "boxes"], [CUBE, CUBE], "group core: expected one box, or at least three, got 2"),
    (STAGES, ["group", 3, "boxes", 0, "weight"], 2, "group core.boxes"),
    (STAGES, ["group", 1, "name"], "near", "group near"),  # the name is taken
    (STAGES, ["stage"], None, "either votes or stages"),
    (STAGES, ["stage"], [], "stage"),
    (STAGES, ["stage", 0, "name"], 1, "stage.name"),
    (STAGES, ["stage", 0, "trees", 0, 0], "free.sum", "stage a: expected only"),
    (STAGES, ["stage", 0, "keep"], "all", "stage a.keep"),
    (STAGES, ["stage", 0, "trees"], None, "stage a.trees: expected a list"),
    (STAGES, ["stage", 0, "trees", 0], "x", "stage a.trees: expected a leaf, or a feature"),
    (STAGES, ["stage", 0, "trees", 0], True, "stage a.trees: expected a number"),
    (STAGES, ["stage", 0, "trees", 0], [], "stage a.trees: expected [feature"),
    (STAGES, ["stage", 0, "trees", 0], ["near.sum", 1, 2], "stage a.trees: expected [feature"),
    (STAGES, ["stage", 0, "trees", 0, 0], "far.sum", "got 'far.sum'"),
    (STAGES, ["stage", 0, "trees", 0, 0], "core.max", "got 'core.max'"),
    (STAGES, ["stage", 0, "trees", 0, 0], 3, "stage a.trees: expected text"),
    (STAGES, ["stage", 0, "trees", 0, 1], NAN, "stage a.trees"),
    (STAGES, ["stage", 0, "trees", 0, 2], 1e9, "stage a.trees: expected a number from -1000 to 1000"),
    (VOTES, ["votes", "mask"], [], "votes"),
    (VOTES, ["votes", "mask", 0, "name"], None, "votes.mask.name"),
    (VOTES, ["votes", "mask", 0, "boxes", 1, "weight"], 1.5, "mask cross.boxes.weight"),
    (VOTES, ["votes", "mask", 0, "boxes", 1, "weight"], 1001, "mask cross.boxes.weight"),
    (VOTES, ["votes", "mirrored", 0], [CUBE], "votes.mirrored: expected pairs of boxes"),
    (VOTES, ["votes", "yaws_deg"], [], "votes: expected at least one mask and 1 to 64 yaws"),
    (VOTES, ["votes", "yaws_deg"], [0.0] * 65, "votes"),
    (VOTES, ["votes", "yaws_deg"], [361.0], "votes.yaws_deg"),
    (VOTES, ["votes", "asymmetry_cost"], -1.0, "votes.asymmetry_cost"),
    (VOTES, ["votes", "asymmetry_cost"], INF, "votes.asymmetry_cost"),
    (VOTES, ["votes", "min_votes"], 3, "votes.min_votes: expected a whole number from 0 to 2, got 3"),
    (VOTES, ["stage"], STAGES["stage"], "either votes or stages"),
]


@pytest.mark.parametrize(("table", "path", "new", "told"), WRONG)
def test_an_error_names_the_cascade_and_the_entry(table, path, new, told):
    with pytest.raises(HeadvoxError) as error:
        parse_cascade(write(changed(table, path, new)), "mine.toml")
    assert error.value.what.startswith("Cascade mine.toml: ")
    assert told in error.value.what
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


def test_a_byte_order_mark_is_no_part_of_a_cascade(tmp_path):
    text = (resources.files("headvox") / "cascades" / "paper.toml").read_text("utf-8")
    (tmp_path / "mine.toml").write_text(text, "utf-8-sig")
    assert load_cascade(tmp_path / "mine.toml").name == load_cascade("paper").name


def test_no_such_cascade():
    with pytest.raises(HeadvoxError, match="Unknown cascade 'nonesuch': expected default or"):
        load_cascade("nonesuch")


def test_a_folder_is_no_cascade(tmp_path):
    with pytest.raises(HeadvoxError, match="Unknown cascade"):
        load_cascade(tmp_path)


def test_a_cascade_from_a_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(scenes.STAGES, encoding="utf-8")
    assert load_cascade(path) == load_cascade(str(path)) == parse_cascade(scenes.STAGES, "mine")


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe\x00",
        b"\x00" * 100,
        b"format = ",
        b"[" * 3000,
        b"x = " + b"[" * 50_000,
        b"x = " + b"{a=" * 50_000,
        b"x = 1" + b"0" * 5000,
        b"a." * 3000 + b"a = 1",
        b"",
    ],
)
def test_what_is_no_cascade_file(tmp_path, content):
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(HeadvoxError, match=r"bad\.toml"):
        load_cascade(path)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "-1" + "0" * 400, "0x" + "f" * 9000])
@pytest.mark.parametrize("where", ["min_score", "voxel_m", "subdivision", "version", "tuned_on"])
def test_whole_numbers_without_end(number, where):
    text = "\n".join(line for line in scenes.STAGES.splitlines() if not line.startswith(f"{where} ="))
    with pytest.raises(HeadvoxError) as error:
        parse_cascade(f"{where} = {number}\n{text}", "huge")
    assert len(str(error.value)) < 400


def test_trees_without_end(tmp_path):
    tree = "0.0"
    for _ in range(200):
        tree = f'["near.sum", 0.1, {tree}, 0.0]'
    text = scenes.STAGES.replace("  0.125,\n", f"  {tree},\n")
    assert text != scenes.STAGES
    with pytest.raises(HeadvoxError, match="30 deep"):
        parse_cascade(text, "deep")


def test_a_file_without_end_is_not_read(tmp_path):
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.write(b"x = [")
        file.seek(4 * 10**9)
        file.write(b"1]")
    with pytest.raises(HeadvoxError, match="larger than 8 MiB"):
        load_cascade(path)


def test_numbers_without_end_are_refused_by_the_size_of_the_file(tmp_path):
    path = tmp_path / "long.toml"
    path.write_bytes(b"x = [" + b"1," * (read_masks.MAX_FILE_BYTES // 2) + b"1]")
    with pytest.raises(HeadvoxError, match="larger than 8 MiB"):
        load_cascade(path)


def test_boxes_that_would_fill_the_memory_are_refused():
    """What the cameras saw is looked up cell by cell: a cascade may not ask for billions."""
    table = changed(STAGES, ["group", 2, "ring", "size"], [2.0, 2.0, 2.0])
    with pytest.raises(HeadvoxError, match="cells"):
        compile_cascade(parse_cascade(write(table), "wide"), 0.005)


def test_weights_that_no_integral_volume_can_hold_are_refused():
    table = changed(
        STAGES, ["gate", 0, "boxes"], [{"centre": [0, 0, 0], "size": [2, 2, 2], "weight": 1000}] * 64
    )
    with pytest.raises(HeadvoxError, match="32 bits"):
        compile_cascade(parse_cascade(write(table), "heavy"), 0.02)


# ---------------------------------------------------------------------------------------------------------- compiled


def test_leaves_only():
    """A cascade that looks at nothing is pointless, but no accident."""
    stage = replace(parse_cascade(scenes.STAGES, "x").stages[0], trees=(0.5,))
    small = parse_cascade(scenes.STAGES, "x")
    cascade = replace(small, conditions=(), groups=(), stages=(stage,), judge=())
    assert compile_cascade(cascade).largest_sum >= 1


def test_sees_tells_whether_a_used_group_looks_at_another_channel():
    cascade = parse_cascade(scenes.STAGES, "x")
    assert cascade.sees
    assert not replace(cascade, judge=cascade.judge[:1]).sees
    assert compile_cascade(cascade).stages.occupied_stages == 2
    assert compile_cascade(cascade).judge.occupied_stages == 1
    assert compile_cascade(replace(cascade, judge=cascade.judge[:1])).judge.occupied_stages == 1


def test_groups_that_no_tree_asks_for_are_left_out():
    compiled = compile_cascade(parse_cascade(scenes.STAGES, "x"))
    assert len(compiled.stages.group_channel) == 2
    assert len(compiled.judge.group_channel) == 4
