"""The command ``headvox completion``: what makes a shell complete commands and flags."""

from __future__ import annotations

import argparse
import importlib
from typing import TYPE_CHECKING

from headvox.commands.flags import GOOD, add_command
from headvox.errors import HeadvoxError

if TYPE_CHECKING:
    from headvox.commands.flags import Commands

SHELLS = ("bash", "zsh", "fish")


def add_to(commands: Commands) -> None:
    """Add ``headvox completion`` to the command line."""
    completion = add_command(commands, "completion", _completion, "print what makes a shell complete headvox")
    completion.add_argument("shell", choices=SHELLS)
    completion.epilog = (
        'bash, zsh: eval "$(headvox completion SHELL)"; fish: headvox completion fish | source'
    )


def _completion(args: argparse.Namespace) -> int:
    try:
        import shtab
    except ImportError:
        raise HeadvoxError("Completion needs shtab.", "pip install 'headvox[completion]'") from None
    if args.shell not in shtab.SUPPORTED_SHELLS:
        raise HeadvoxError(f"This shtab knows no {args.shell}.", "pip install -U shtab")
    print(shtab.complete(whole_parser(), args.shell))
    return GOOD


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line, with those of the commands that read their own flags in it."""
    from headvox.cli import MODULES, _parser

    parser = _parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, (module, _) in MODULES.items():
        own = importlib.import_module(module)._parser()
        own.prog = f"headvox {name}"
        commands.choices[name] = own
    return parser
