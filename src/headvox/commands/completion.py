"""The command ``headvox completion``: what makes a shell complete commands and flags."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from headvox.commands.flags import GOOD, add_command
from headvox.errors import HeadvoxError, MissingExtra

if TYPE_CHECKING:
    from headvox.commands.flags import Commands

SHELLS = ("bash", "zsh", "fish")


def add_to(commands: Commands, whole_parser: Callable[[], argparse.ArgumentParser]) -> None:
    """Add ``headvox completion`` to the command line, of which ``whole_parser`` returns all."""
    completion = add_command(commands, "completion", _completion, "print what makes a shell complete headvox")
    completion.add_argument("shell", choices=SHELLS)
    completion.set_defaults(whole_parser=whole_parser)
    completion.epilog = (
        'bash, zsh: eval "$(headvox completion SHELL)"; fish: headvox completion fish | source'
    )


def _completion(args: argparse.Namespace) -> int:
    try:
        import shtab
    except ImportError:
        raise MissingExtra("Completion needs shtab.", "completion") from None
    if args.shell not in shtab.SUPPORTED_SHELLS:
        raise HeadvoxError(f"This shtab knows no {args.shell}.", "pip install -U shtab")
    print(shtab.complete(args.whole_parser(), args.shell))
    return GOOD
