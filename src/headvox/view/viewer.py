"""rerun's viewer as its own process: it listens to this machine only, within limits of memory, and tells nobody."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import rerun_cli

PORT = 9876  # rerun's own
MEMORY, SERVER_MEMORY = "1GB", "128MB"  # the oldest is dropped
START_S = 30.0


def url() -> str:
    """Return where a viewer listens on this machine."""
    return f"rerun+http://127.0.0.1:{PORT}/proxy"


def quiet_environment() -> dict[str, str]:
    """Return an environment in which rerun collects and sends nothing about its use.

    The switch is ``rerun analytics disable``, which writes a file of settings: here into a folder of our own, so that
    the settings of the person are left alone.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "headvox" / "rerun"
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "XDG_CONFIG_HOME": str(folder)}
    subprocess.run([program(), "analytics", "disable"], env=environment, check=True, capture_output=True)
    return environment


def program() -> str:
    """Return the executable of the viewer that is of the same version as the library."""
    return str(Path(rerun_cli.__file__).parent / ("rerun.exe" if sys.platform == "win32" else "rerun"))


def start() -> None:
    """Start a viewer that outlives this process, unless one listens already.

    Raises:
        OSError: it did not start.
    """
    if _listens():
        return
    # Without --bind, it would listen to the whole network. It outlives us: it must not hold our output open.
    command = [
        program(), "--bind", "127.0.0.1", "--port", str(PORT), "--memory-limit", MEMORY,
        "--server-memory-limit", SERVER_MEMORY, "--expect-data-soon",
    ]  # fmt: skip
    viewer = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    end = time.monotonic() + START_S
    while not _listens():
        if viewer.poll() is not None or time.monotonic() > end:
            raise OSError(f"the viewer did not start: exit code {viewer.poll()}")
        time.sleep(0.05)


def _listens() -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex(("127.0.0.1", PORT)) == 0
