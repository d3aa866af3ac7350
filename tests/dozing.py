"""``python dozing.py FOLDER``: two workers doze, and leave a file there when they begin and when they are broken."""

import os
import sys
import time
from functools import partial
from pathlib import Path

from headvox.machine.interrupts import terminable
from headvox.parallel.workers import Workers


def doze(_: int, folder: Path) -> None:
    """Do what takes very long."""
    (folder / f"{os.getpid()}.begun").touch()
    try:
        time.sleep(600)
    finally:
        (folder / f"{os.getpid()}.ended").touch()


if __name__ == "__main__":
    with terminable():
        list(Workers(2).map(partial(doze, folder=Path(sys.argv[1])), range(8)))
