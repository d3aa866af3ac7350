"""A sink of your own: what takes the heads of each frame, to a socket, a data base, a controller.

python examples/own_sink.py [SOURCE]      (without SOURCE: the sample that ships with headvox)

This one sends a datagram a frame: the same line of JSON that `headvox run --json` prints.
"""

from __future__ import annotations

import socket
import sys
from contextlib import closing
from pathlib import Path

import headvox
from headvox.run import run
from headvox.sinks import Result
from headvox.sinks.jsonl import to_json

ADDRESS = ("127.0.0.1", 47_800)


class Datagrams:
    """Sends, and never waits for who listens; see headvox.sinks.Sink for the contract."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = address

    def write(self, result: Result) -> None:
        """Take the result of one frame."""
        self._socket.sendto(to_json(result).encode(), self._address)

    def close(self) -> None:
        """Finish."""
        self._socket.close()


def main(place: str | Path, address: tuple[str, int] = ADDRESS) -> None:
    """Run over a source, and send what is found."""
    with (
        closing(headvox.open_source(place)) as source,
        closing(headvox.Detector()) as detector,
        closing(Datagrams(address)) as sink,
    ):
        report = run(source, detector, [sink], tracker=headvox.Tracker())
    print(f"sent {report.frames - report.bad} lines to {address[0]}:{address[1]}")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else headvox.sample_folder())
    except headvox.HeadvoxError as error:
        sys.exit(str(error))
