"""The command ``headvox``, and ``python -m headvox``."""

from __future__ import annotations

import sys

INTERRUPTED = 130  # as headvox.commands.flags has it, which is not to be imported before Ctrl-C is heeded


def main() -> int:
    """Run the command line of the process; Ctrl-C ends it quietly from the first import on."""
    try:
        from headvox import cli

        return cli.main()
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
