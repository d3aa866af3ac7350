"""A CUDA graph of all that a frame needs: one call in place of some thirty launches and copies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from headvox.cuda.lanes import SIMULATED


def capture(stream: Any, enqueue: Callable[[], None]) -> Callable[[], None] | None:
    """Return a call that does again what ``enqueue`` puts on ``stream``; None where that is not to be had.

    Nothing of it is done now. All kernels have to have been launched before: a kernel is loaded when it first is, and
    that cannot be part of a graph.
    """
    if SIMULATED:
        return None
    try:
        from cuda.core import Stream

        core = Stream.from_handle(int(stream))
        builder = core.create_graph_builder()
        builder.begin_building()
        try:
            enqueue()
        finally:
            builder.end_building()
        graph = builder.complete()
    except Exception:  # an older driver or cuda-core; if the device is lost, the next launch tells
        return None

    def launch() -> None:
        graph.launch(core)

    return launch
