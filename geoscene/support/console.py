"""Shared by both command-line programs: option parsing, one-line errors, exit codes, progress bars, JSON."""

from __future__ import annotations

import atexit
import errno
import gc
import json
import logging
import math
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin

from cyclopts import (
    App,
    ArgumentCollection,
    CoercionError,
    CycloptsError,
    Parameter,
    RepeatArgumentError,
    Token,
)

from geoscene.errors import DamagedFileError, InputError
from geoscene.support.option_values import parts_of, words_of
from geoscene.support.registry import unknown_name
from geoscene.support.storage import url_of
from geoscene.support.urls import without_secrets

DONE, FAILURE, USAGE = 0, 1, 2
"""Exit codes: success, failure, unusable input or options."""

_COLLECTED = (500_000, 50, 50)
"""Thresholds of Python's search for cyclic garbage: with its defaults it takes a tenth of a build, whose many
objects are kept. The first is more than what programs import and short drives make."""

_THREADS = "OPENBLAS_NUM_THREADS"
"""Environment variable of NumPy and SciPy, which are imported later: threads of their linear algebra wait
busily for work, of which the small blocks of sparse matrices give them none."""

_NO_SPACE = "; free some space and run the same command again"
_PERMISSION = "; give a path that you may write to and files that you may read"
_NO_DIRECTORY = "; a file is where a directory is needed"
_HINTS = {
    errno.EEXIST: _NO_DIRECTORY,
    errno.ENOTDIR: _NO_DIRECTORY,
    errno.EISDIR: "; a directory is where a file is needed",
    errno.ENOSPC: _NO_SPACE,
    errno.EDQUOT: _NO_SPACE,
    errno.EACCES: _PERMISSION,
    errno.EPERM: _PERMISSION,
    errno.EROFS: "; give a path that you may write to",
}
_TEMPORARY = re.compile(r"\.\d+\.part(?=$|[./])|(\.new|\.old)?\.part(?=$|/)|\.lock$")
"""What names of files have more than those that they become."""

_BROKEN_PIPE = 141

_INTERRUPTIONS = (signal.SIGINT, signal.SIGTERM)
"""Signals of Ctrl-C, and of ``timeout``, ``kill`` and batch systems; the exit code is 128 plus the number."""

_RESUMED = ("build", "drive", "sweep")
"""Commands that go on where they were interrupted."""

_GRACE = 1.5
"""Seconds to clear up in after an interruption, which may also get lost in callbacks of compiled code."""

_NUMBERS = re.compile(r"-\d+(\.\d*)?(,-?\d+(\.\d*)?)+")


def guard_numbers(words: Sequence[str]) -> list[str]:
    """Put a space before ``-30.1,-51.2``, so that it is not parsed as an option; number parsers ignore it."""
    return [f" {word}" if _NUMBERS.fullmatch(word) else word for word in words]


def check_given(words: Sequence[str]) -> None:
    """Raise InputError for an empty value, as of a variable of a script that is not set."""
    for before, word in zip(("", *words), words, strict=False):
        flag, equals, value = word.partition("=") if word.startswith("--") else (before, "=", word)
        if equals and not value.strip():
            name = f"{flag} " if flag.startswith("-") else ""
            raise InputError(f"{name}{value!r}: is empty; give a value, or leave it out")


SEVERAL = Parameter(consume_multiple=True)
"""Parameter of an option that takes all values up to the next option."""


def shown_default(value: object) -> str | None:
    """Text of a default value in help; None for an empty default."""
    if isinstance(value, tuple):
        value = ",".join(map(str, value))
    return None if value is None or value is False or value == "" else str(value)


DEFAULTS = Parameter(negative=(), show_default=shown_default)
"""Parameter of every option of both programs."""


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Report:
    """Options of a command's output."""

    overwrite: bool = False
    """Replace an existing output."""

    json: bool = False
    """Print the summary as JSON."""

    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"])] = False
    """Show no progress bars."""


def _words(_: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    return tuple(word for token in tokens for word in words_of(token.value))


def parts(_: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    """Converter of options that take comma-separated texts."""
    return tuple(part for token in tokens for part in parts_of(token.value))


WORDS = Parameter(converter=_words, n_tokens=1, metavar="STR,...")
"""Parameter of an option that takes comma-separated words, as a tuple in lower case."""


def degrees(names: str) -> Parameter:
    """Parameter of an option that takes comma-separated degrees: LAT,LON, or W,S,E,N as they are given."""
    count = names.count(",") + 1
    read = numbers(count, f"{count} numbers in degrees as {names}")

    def convert(kind: object, tokens: Sequence[Token]) -> tuple[float, ...]:
        values = read(kind, tokens)
        if names == "LAT,LON" and not (abs(values[0]) <= 90 and abs(values[1]) <= 180):
            raise ValueError("give a latitude and a longitude in degrees")
        return values

    return Parameter(converter=convert, n_tokens=1, metavar=names)


def numbers(count: int, wanted: str) -> Callable[[object, Sequence[Token]], tuple[float, ...]]:
    """Converter of options that take finite numbers separated by commas.

    wanted : what to give, for messages
    """

    def convert(_: object, tokens: Sequence[Token]) -> tuple[float, ...]:
        values: tuple[float, ...] = ()
        with suppress(ValueError):
            values = tuple(float(word) for word in only_value(tokens).split(","))
        if len(values) != count or not all(map(math.isfinite, values)):
            raise ValueError(f"give {wanted}")
        return values

    return convert


def number(kind: object, tokens: Sequence[Token]) -> float:
    """Converter of options that take a finite number."""
    return numbers(1, "a number")(kind, tokens)[0]


def only_value(tokens: Sequence[Token]) -> str:
    """The value of an option that is given once; raises ValueError if it is repeated."""
    if len(tokens) > 1:
        raise ValueError("is given twice; give it once")
    return tokens[0].value


def whole(_: object, tokens: Sequence[Token]) -> int:
    """Converter of options that take a whole number; 1.5 is an error."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError("give a whole number") from None


def main(
    app: App,
    roots: tuple[type[Exception], ...],
    *,
    usage: tuple[type[Exception], ...],
    removed: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Run a program and exit with its code.

    roots   : exceptions printed as one line, exit code 1
    usage   : those of them caused by input or options, exit code 2; DamagedFileError has 1
    removed : what to write instead of former options, by flag
    """
    _open_streams()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Formatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    gc.set_threshold(*_COLLECTED)
    atexit.register(gc.freeze)  # the end of a process need not search what is left: 0.5 s of a drive
    os.environ.setdefault(_THREADS, "1")
    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it logs the errors that it raises
    logging.getLogger("geoscene.support.cluster").setLevel(
        logging.INFO
    )  # it names the page with the progress
    try:
        with _ended_by_interruptions(app):
            check_given(sys.argv[1:])
            words = guard_numbers(sys.argv[1:])
            code = app(words, result_action="return_value", exit_on_error=False, print_error=False)
            sys.stdout.flush()
    except CycloptsError as error:
        flag = next((word for word in sys.argv[1:] if word in removed), "")
        message = f"{flag} is removed: {removed[flag]}" if flag else _usage_text(error)
        _print_error(app, f"{message}; see {app.name[0]} {_command(app)}--help")
        sys.exit(USAGE)
    except roots as error:
        _print_error(app, _with_option(app, with_flags(app, str(error))))
        failed = isinstance(error, DamagedFileError) or not isinstance(error, usage)
        sys.exit(FAILURE if failed else USAGE)
    except BrokenPipeError:  # the reader of standard output has ended, as in "| head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_BROKEN_PIPE)
    except UnicodeEncodeError as error:
        name = "".join(map(_shown_byte, error.object))
        _print_error(app, f"{name[:200]}: is not UTF-8, as names here must be; rename it")
        sys.exit(USAGE)
    except MemoryError:
        _print_error(app, "out of memory; take a smaller area or fewer workers")
        sys.exit(FAILURE)
    except OSError as error:
        # Files are first written as <name>.<process>.part; the message names the final file.
        name = _TEMPORARY.sub("", str(error.filename or "the system"))
        hint = _HINTS.get(error.errno or 0, "")
        _print_error(app, _with_option(app, f"{name}: {error.strerror or error}{hint}"))
        sys.exit(FAILURE)
    sys.exit(code if isinstance(code, int) else DONE)


_WANTED: dict[Any, str] = {float: "give a number", int: "give a whole number", bool: "give true or false"}
"""What may be given for a type of Python."""


def _usage_text(error: CycloptsError) -> str:
    """A message of the parser; of a value: the option, the value and what to give."""
    if isinstance(error, RepeatArgumentError):
        return f"{error.token.keyword} {error.token.value}: is given twice; give it once"
    if not isinstance(error, CoercionError) or error.argument is None:
        return str(error).rstrip(".")
    tokens = [error.token] if error.token else error.argument.tokens
    name = tokens[0].keyword or error.argument.name.lstrip("-").upper()
    values = [token.value.strip() for token in tokens]
    kind = error.target_type
    if get_origin(kind) is Literal:
        return unknown_name(name, values[0], known=get_args(kind))
    why = str(error.msg or next(_WANTED[one] for one in (kind, *get_args(kind)) if one in _WANTED))
    value = next((value for value in values if why.startswith(f"{value}: ")), " ".join(values))
    return f"{name} {value}: {why.removeprefix(f'{value}: ')}"


def _open_streams() -> None:
    """Open standard streams that are closed, so that no file of the program takes their place.

    Paths need not be UTF-8: what standard output and error cannot encode is written as escapes.
    """
    missing = [number for number in (0, 1, 2) if not _is_open(number)]
    for _ in missing:  # each takes the lowest number that is free
        os.open(os.devnull, os.O_RDWR)
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))
        with suppress(AttributeError):  # of a stream of another kind, as of notebooks
            getattr(sys, name).reconfigure(errors="backslashreplace")


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def _shown_byte(character: str) -> str:
    """A character; of a byte of a path that is no UTF-8 its value."""
    code = ord(character)
    return f"\\x{code - 0xDC00:02x}" if 0xDC80 <= code <= 0xDCFF else character


class _Formatter(logging.Formatter):
    """Formats log messages without secrets of addresses."""

    def format(self, record: logging.LogRecord) -> str:
        """The text of a message."""
        return without_secrets(super().format(record))


@contextmanager
def _ended_by_interruptions(app: App) -> Iterator[None]:
    """Let the first interruption of the block raise KeyboardInterrupt, and end the program soon after.

    Any exception of the block counts as an interruption once a signal has arrived: compiled code turns a
    KeyboardInterrupt into other errors. The former signal handlers are restored at the end of the block.
    """
    arrived: list[int] = []

    def interrupt(number: int, _: object) -> None:
        arrived.append(number)
        if hasattr(signal, "setitimer"):
            for interruption in _INTERRUPTIONS:  # ``timeout`` sends two
                signal.signal(interruption, signal.SIG_IGN)
            signal.signal(signal.SIGALRM, lambda *_: _exit_interrupted(app, number))
            signal.setitimer(signal.ITIMER_REAL, _GRACE)
        raise KeyboardInterrupt

    former = {interruption: signal.getsignal(interruption) for interruption in _INTERRUPTIONS}
    for interruption, handler in former.items():
        if handler != signal.SIG_IGN:  # as of SIGINT in the background of a script
            signal.signal(interruption, interrupt)
    try:
        yield
    except BaseException:
        if arrived:
            _exit_interrupted(app, arrived[0])
        raise
    finally:
        for interruption, handler in former.items():
            if handler is not None:  # None: installed by other than Python
                signal.signal(interruption, handler)


def _exit_interrupted(app: App, number: int) -> NoReturn:
    """End at once, without waiting for other threads; files appear when they are complete."""
    from multiprocessing import active_children  # noqa: PLC0415 - slow to import

    for child in active_children():
        child.kill()
    with suppress(RuntimeError):  # if it was interrupted in writing to standard error
        resumed = _command(app).strip() in _RESUMED
        _print_error(app, "interrupted" + "; repeat the command to resume" * resumed)
        sys.stderr.flush()
    os._exit(128 + number)


def _command(app: App) -> str:
    """The command with its parent commands, each followed by a space."""
    return "".join(f"{name} " for name in app.parse_commands(sys.argv[1:])[0])


def with_flags(app: App, text: str) -> str:
    """A library message with parameters (`` `tile_size` ``) replaced by flags of the command (--tile-size).

    Parameters that the command does not have keep their name.
    """
    flags = {argument.field_info.name: argument.name for argument in _arguments(app)} if "`" in text else {}
    return re.sub(r"`(\w+)`", lambda found: flags.get(found[1], found[1]), text)


def _with_option(app: App, text: str) -> str:
    """A library message about the value of an option that does not name it, with the flag before it.

    The value is at the beginning, as of a file, or in quotes. Outputs stay without: what is written is known.
    """
    takes = {
        name: bool(argument.parameter.consume_multiple)
        for argument in _arguments(app)
        if argument.hint is not bool and "--out" not in argument.names
        for name in argument.names
    }
    flag, subject = "", text.partition(": ")[0]
    for word in sys.argv[1:]:
        name, equals, value = word.partition("=")
        if name in takes:
            flag = name
        elif word.startswith("-") and not _NUMBERS.fullmatch(word):
            flag = ""
        given = value if name in takes else word
        said = {given, *re.split("[=,]", given), *re.split("[=,]", given.lower())}
        if flag and subject in said:
            return f"{flag} {text}"
        if flag and flag not in text and any(part and repr(part) in text for part in said):
            return f"{flag}: {text}"
        if flag and (equals or name not in takes) and not takes[flag]:
            flag = ""
    return text


def _arguments(app: App) -> ArgumentCollection | Sequence[Any]:
    """Parameters of the command that the program is called with; none of a group of commands."""
    words, command = app.parse_commands(sys.argv[1:])[0], app
    for word in words:
        command = command[word]
    return command.assemble_argument_collection() if words and command.default_command is not None else ()


def _print_error(app: App, message: object) -> None:
    text = without_secrets(" ".join(with_flags(app, str(message)).split()))
    text = "".join(map(_shown_byte, text))
    with suppress(BrokenPipeError):  # nobody reads it
        print(f"{app.name[0]}: {text}", file=sys.stderr)


def command_line(*words: object) -> str:
    """Words as a command to paste into a shell, with quotes where needed."""
    return shlex.join(map(str, words))


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document as JSON on standard output."""
    print(json.dumps(document, indent=2, ensure_ascii=False))


def note_new_folder(out: Path) -> None:
    """Say on standard error which folder is made to hold an output, so that a mistyped path is noticed.

    Raises InputError for a URL, and for a path that is no UTF-8, which not all formats can name.
    """
    try:
        os.fspath(out).encode()
    except UnicodeEncodeError:
        raise InputError(f"`out` {out}: is not UTF-8; give another path") from None
    if url := url_of(out):
        raise InputError(
            f"`out` {without_secrets(url)}: only geoscene build and lidar drive write to object storage;"
            " give a path of this machine"
        )
    if not (folder := out.absolute().parent).exists():
        print(f"{folder}: this folder does not exist and is made", file=sys.stderr)
