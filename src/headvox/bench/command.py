"""``headvox bench`` makes its own input, measures, and says on what machine."""

from __future__ import annotations

import json
import sys

from headvox.bench.measure import MAX_RANGE_M, measure
from headvox.bench.report import report
from headvox.commands.flags import Parser, whole_number


def _parser() -> Parser:
    parser = Parser(
        "headvox bench",
        description="Measure how fast headvox is on this machine. It makes its own input.",
        epilog="Close what else runs: two threads on two busy cores are slower than one.",
    )
    parser.add_argument("--cascade", default="default", metavar="NAME|FILE", help="which masks (default)")
    parser.add_argument(
        "--refine",
        choices=("pose", "sphere", "none"),
        default="pose",
        help="how a head's centre is found (pose)",
    )
    parser.add_argument(
        "--backend", choices=("cpu", "cuda"), default="cpu", help="measure the CPU (default) or a GPU"
    )
    parser.add_argument("--rounds", type=whole_number, metavar="N", help="rounds of calls (100)")
    parser.add_argument(
        "--quick", action="store_true", help="a few rounds on small images: only to see it work"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    return parser


def main(argv: list[str]) -> int:
    """Run ``headvox bench`` with the flags ``argv``; return the exit code.

    Raises:
        HeadvoxError: no such cascade.
    """
    try:
        args = _parser().parse_args(argv)
    except SystemExit as done:  # after --help or wrong usage
        return int(done.code or 0)
    rounds = args.rounds or (5 if args.quick else 100)
    frames = 20 if args.quick else 1000

    def note(text: str) -> None:
        print(f"headvox bench: {text}", file=sys.stderr, flush=True)

    if args.backend == "cuda":
        from headvox.cuda.device import check_real_device

        check_real_device()
        from headvox.cuda import bench as gpu

        result = gpu.bench(args.cascade, args.refine, MAX_RANGE_M, rounds, args.quick, note)
        print(json.dumps(result, indent=1) if args.json else gpu.report(result))
        return 0
    result = measure(args.cascade, args.refine, rounds, frames, args.quick, note)
    print(json.dumps(result, indent=1) if args.json else report(result))
    return 0
