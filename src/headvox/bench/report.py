"""What ``headvox bench`` found, as tables."""

from __future__ import annotations

from typing import Any

from headvox.commands.table import table

Values = dict[str, Any]


def report(result: Values) -> str:
    """Return what :func:`headvox.bench.measure.measure` found, as tables."""
    machine, data = result["machine"], result["input"]
    cores = f"{machine['cores_for_this_process'] or machine['cores']} of {machine['cores']} cores"
    versions = f"Python {machine['python']}, numpy {machine['numpy']}, numba {machine['numba']}"
    head = [
        ["machine", f"{machine['processor']}, {cores}, {machine['system']}"],
        ["software", f"headvox {result['headvox']}, {versions}"],
        [
            "load average",
            f"{_loads(machine['load_average'])} before, {_loads(machine['load_average_after'])} after",
        ],
        ["cascade", result["cascade"]],
        ["refine", result["refine"]],
        [
            "input",
            f"{len(data['cameras'])} depth images of {data['cameras'][0]}, {data['points']} points, "
            f"{data['points_within_range']} of them within {data['max_range_m']:g} m; {data['people']} people",
        ],
        ["candidates", ", ".join(f"{count} in {name}" for name, count in result["candidates"].items())],
        [
            "rounds",
            f"{result['rounds']}, everything in turn: {result['calls_in_a_row']} calls in a row, "
            "of which the first (cold) and the second are told apart",
        ],
    ]
    columns = ["ms", "p50", "p99", "p99/p50", "cold p50", "2nd p50", "2nd p99", "x copy", "x Open3D", "heads"]
    rows = [
        [
            name, f"{row['p50']:.3f}", f"{row['p99']:.3f}", _number(row["p99_over_p50"], 2), f"{row['cold_p50']:.3f}",
            f"{row['second_p50']:.3f}", f"{row['second_p99']:.3f}",
            _number(row["times_the_copy"], 2), _number(row["times_open3d"], 3), _number(row["heads"], 0),
        ]
        for name, row in result["ms"].items()
    ]  # fmt: skip
    parts = [table([], head), table(columns, rows)]
    if result["open3d"] is None:
        parts.append("Open3D is not installed: its voxel grid was not measured.")
    parts += [_stage_table(result), _points_table(result["by_points"]), _boxes_table(result["by_box_size"])]
    parts.append(
        _memory_table(result["memory"], result["first_result_s"], result["same_heads_with_2_threads"])
    )
    return "\n\n".join(parts)


def _stage_table(result: Values) -> str:
    stages = result["stages_ms"]
    names = list(next(iter(stages.values())))
    rows = [[stage, *(f"{of[stage]['p50']:.3f}" for of in stages.values())] for stage in names]
    return table(["ms a stage, p50", *stages], rows)


def _points_table(by_points: Values) -> str:
    rows = [[str(row["points"]), f"{row['p50']:.3f}", f"{row['voxelize']:.3f}"] for row in by_points["rows"]]
    lines = [
        f"{name}: {line['fixed_ms']:.3f} ms + {line['ms_a_million_points']:.3f} ms a million points, "
        f"{line['farthest_from_the_line']:.1%} off at most"
        for name, line in by_points.items()
        if name != "rows"
    ]
    return "\n".join([table(["points", "detect, ms", "voxelize, ms"], rows), *lines])


def _boxes_table(by_size: Values) -> str:
    rows = [[str(row["voxels"]), f"{row['gate_p50']:.3f}"] for row in by_size["rows"]]
    text = table(["edge of the boxes, voxels", "gate of 8 boxes, ms"], rows)
    return f"{text}\nslowest / fastest: {by_size['slowest_over_fastest']:.2f}"


def _memory_table(memory: Values, first: Values, same: bool) -> str:
    growth = memory["resident_growth_bytes"]
    rows = [
        ["allocated at a time, a frame", f"{memory['peak_bytes_a_frame']} bytes"],
        ["the images of a frame", f"{memory['image_bytes']} bytes"],
        ["kept, a frame", f"{memory['kept_bytes_a_frame']} bytes"],
        [
            f"resident memory over {memory['frames']} frames",
            "not known here" if growth is None else f"{growth:+d} bytes",
        ],
        ["the same heads with 2 threads, bit for bit", "yes" if same else "NO"],
        ["first heads, from the start of Python", f"{first['from_start_of_python']:.2f} s"],
        ["of that: making a detector", f"{first['make_a_detector']:.2f} s"],
        ["of that: the first frame", f"{first['first_frame']:.2f} s"],
    ]
    return table([], rows)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _loads(loads: list[float] | None) -> str:
    return "unknown" if loads is None else " ".join(f"{v:.2f}" for v in loads)
