"""The options that the programs declare, by commands, with bad values for each kind."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, get_args, get_origin

PROGRAMS = ("geoscene", "lidar")


@dataclass(frozen=True)
class Option:
    """An option or a positional parameter of a command.

    flag : as written, such as ``--seed``; empty for a positional parameter
    kind : ``switch``, ``number``, ``whole``, ``choice``, ``path`` or ``text``
    """

    program: str
    command: str
    name: str
    flag: str
    kind: str

    def __str__(self):
        return f"{self.program} {self.command} {self.flag or self.name}"


def _kind(hint: Any) -> str:
    """The kind of an option's type."""
    names = [getattr(one, "__name__", str(one)) for one in (hint, *get_args(hint))]
    if get_origin(hint) is Literal:
        return "choice"
    if hint is bool:
        return "switch"
    if "float" in names:
        return "number"
    if "int" in names:
        return "whole"
    return "path" if "Path" in names else "text"


def declared_options(*programs: str) -> list[Option]:
    """All options of all commands of the programs."""
    found = []
    for program in programs or PROGRAMS:
        app = import_module(f"{program}.cli").app
        for command in app:
            if not command.startswith("-"):
                for argument in app[command].assemble_argument_collection():
                    flag = next((name for name in argument.names if name.startswith("--")), "")
                    name = argument.field_info.name
                    if argument.names != ("*",):  # a class of options, which follow one by one
                        found.append(Option(program, command, name, flag, _kind(argument.hint)))
    return found
