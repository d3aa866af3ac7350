"""Where results go: see :class:`headvox.sinks.result.Sink` for the contract."""

from __future__ import annotations

from pathlib import Path

from headvox.errors import HeadvoxError
from headvox.sinks.result import Result, Sink

__all__ = ["SUFFIXES", "Result", "Sink", "open_sink"]

SUFFIXES = (".jsonl", ".csv", ".tum", ".mcap")


def open_sink(path: Path, frame: str = "world") -> Sink:
    """Return a sink that writes ``path``, of the kind that its suffix says; an older file is
    replaced by the first result: without one it stays.

    ``frame`` is what ROS calls the world that the heads are in.

    Raises:
        HeadvoxError: an unknown suffix, or a file that cannot be made.
    """
    if path.suffix == ".jsonl":
        from headvox.sinks.jsonl import JsonFile

        return JsonFile(path)
    if path.suffix == ".csv":
        from headvox.sinks.csvfile import CsvFile

        return CsvFile(path)
    if path.suffix == ".tum":
        from headvox.sinks.tum import TumFiles

        return TumFiles(path)
    if path.suffix == ".mcap":
        from headvox.sinks.mcapfile import McapSink

        return McapSink(path, frame)
    raise HeadvoxError(
        f"Output {path}: expected a name that ends with {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}.",
        "Rename it.",
    )
