"""The command line. Each command is a frozen dataclass in a file of its own, parsed by tyro; its `run` does the work.

A new command is one more line in `COMMANDS`. Only the command that was typed is imported, so the others cost nothing.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

from uavrl import __version__
from uavrl.errors import ConfigError, UavrlError

Made = TypeVar("Made")


class Command(NamedTuple):
    """Where a command's dataclass is, and what `uavrl --help` says of it."""

    target: str  # module:Class
    summary: str


COMMANDS: dict[str, Command] = {
    "scenario show": Command("uavrl.cli.scenario:ScenarioShow", "print a scenario as TOML, every field explained"),
    "scenario diff": Command("uavrl.cli.scenario:ScenarioDiff", "list the fields in which two scenarios differ"),
    "scenario check": Command("uavrl.cli.scenario:ScenarioCheck", "validate a scenario file"),
    "data show": Command("uavrl.cli.data:DataShow", "report behaviour and coverage of logged flights"),
    "data select": Command("uavrl.cli.data:DataSelect", "select logged flights by size, quality and seed"),
    "data convert": Command("uavrl.cli.data:DataConvert", "write logged flights in another form"),
    "data relabel": Command("uavrl.cli.data:DataRelabel", "give logged flights the rewards of another objective"),
    "collect": Command("uavrl.cli.collect:Collect", "log the flights of an agent that learns online"),
    "train": Command("uavrl.cli.train:Train", "learn a policy from logged flights alone"),
    "distill": Command("uavrl.cli.distill:Distill", "teach a policy of one pass what a Diffusion-SAC decides"),
    "evaluate": Command("uavrl.cli.evaluate:Evaluate", "fly policies on equal layouts, starts and fading"),
    "export": Command("uavrl.cli.export:Export", "write a policy as one file that flies without torch"),
    "reproduce": Command("uavrl.cli.reproduce:Reproduce", "make the paper's figures and judge its claims"),
    "report": Command("uavrl.cli.report:Report", "put what `uavrl reproduce` computed on one web page"),
    "ablate": Command("uavrl.cli.ablate:Ablate", "change one setting of Diffusion-SAC at a time and measure"),
    "bench simulate": Command(
        "uavrl.cli.bench:BenchSimulate", "measure environment steps a second, beside their floors"
    ),
    "bench train": Command("uavrl.cli.bench:BenchTrain", "measure updates a second, beside what the products allow"),
    "bench decide": Command(
        "uavrl.cli.bench:BenchDecide", "measure decisions of exported policies, beside their floors"
    ),
    "demo": Command("uavrl.cli.demo:Demo", "learn a small policy, judge it, and show it"),
    "watch": Command("uavrl.cli.watch:Watch", "make a web page of one flight of a policy"),
}

_PLAINLY = {  # Python's words for a number that is none
    r"invalid literal for int\(\) with base 10: (.*)": r"\1, allowed: a whole number",
    r"could not convert string to float: (.*)": r"\1, allowed: a number",
    r"no type matching \{None\}\|(\w+) could be instantiated from \[(.*?)\]\..*": r"\2, allowed: \1",
}
_BOX = re.compile(r"\x1b\[[0-9;]*m|[\u2500-\u257f]")  # colours, and the frame that tyro draws around its errors


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return the process's exit code, as of `guarded`."""
    words = list(sys.argv[1:] if argv is None else argv)
    return guarded(lambda: _dispatch(words))


def guarded(action: Callable[[], object]) -> int:
    """Exit code of what was done: 0; 2 for a user's error, or a file's or a disk's, told in one line; 130; 141.

    130 is interrupted, 141 that nobody reads the output any more.
    """
    try:
        action()
        sys.stdout.flush()
    except UavrlError as error:
        print(f"uavrl: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("uavrl: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        _drop_output()
        return 141
    except OSError as error:  # a full disk, a directory that may not be written, a file where a directory is meant
        place = f"'{error.filename}': " if error.filename is not None else ""
        print(f"uavrl: error: {place}{' '.join(str(error.strerror or error).split())}", file=sys.stderr)
        try:
            sys.stdout.flush()
        except OSError:  # it is the output that cannot be written
            _drop_output()
        return 2
    return 0


def _drop_output() -> None:
    """Or the interpreter's last flush fails, too."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(words: list[str]) -> None:
    """Find the command that `words` begins with, parse the rest and run it."""
    if not words or words[0] in ("-h", "--help"):
        print(_usage(COMMANDS))
        return
    if words[0] == "--version":
        print(f"uavrl {__version__}")
        return
    for length in (1, 2):
        name = " ".join(words[:length])
        if name in COMMANDS:
            command = parse(name, words[length:])
            if command is not None:
                command.run()
            return
    group = {name: command for name, command in COMMANDS.items() if name.split()[0] == words[0]}
    if group and len(words) == 2 and words[1] in ("-h", "--help"):
        print(_usage(group))
        return
    if not group:
        raise ConfigError(f"command '{words[0]}' does not exist, allowed: {', '.join(_first_words())}, --version")
    allowed = ", ".join(name.split()[1] for name in group)
    if len(words) == 1:
        raise ConfigError(f"command '{words[0]}' needs one of: {allowed}")
    raise ConfigError(f"command '{words[0]} {words[1]}' does not exist, allowed: {allowed}")


def parse(name: str, words: Sequence[str]) -> Any:
    """The command's dataclass, filled from the words after its name; None where they asked for help only.

    Raises:
        ConfigError: as of `made_from`.
    """
    module, _, attribute = COMMANDS[name].target.partition(":")
    return made_from(words, getattr(importlib.import_module(module), attribute), f"uavrl {name}")


def made_from(words: Sequence[str], kind: Callable[..., Made], program: str) -> Made | None:
    """What `kind`, a class or a function, makes of the words that follow `program`; None where they ask for help only.

    Raises:
        ConfigError: an unknown option, a missing one, or a value that is not allowed.
    """
    import tyro  # here: `uavrl --version` does without it

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _unbroken_lines(words):
            return tyro.cli(kind, prog=program, args=words, config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as stop:
        if stop.code in (0, None):
            return None
        raise ConfigError(f"{_condense(complaint.getvalue())} (see: {program} --help)") from None


@contextlib.contextmanager
def _unbroken_lines(words: Sequence[str]) -> Iterator[None]:
    """Let tyro see a terminal of endless lines, or it breaks what the user typed; help is shown as it is."""
    known = os.environ.get("COLUMNS")
    if not {"-h", "--help"} & set(words):
        os.environ["COLUMNS"] = "100000"
    try:
        yield
    finally:
        os.environ.pop("COLUMNS", None)
        if known is not None:
            os.environ["COLUMNS"] = known


def _condense(box: str) -> str:
    """One line from the framed text with which tyro refuses its arguments: what comes before the help."""
    lines: list[str] = []
    for raw in box.splitlines():
        line = " ".join(_BOX.sub("", raw).split())
        if lines and (line.strip("-") == "" if line else "\u2500" in raw):
            if len(lines) == 1:
                continue  # the title's own rule, where the output knows ASCII alone
            break  # a rule or the frame's end: what follows repeats the help
        if line:
            lines.append(line)
    if len(lines) > 1 and lines[1].startswith(lines[0]):
        del lines[0]  # some titles repeat the message
    title, *rest = lines or ["wrong arguments"]
    told = f"{title}: {' '.join(rest)}".rstrip(": .") if rest else title
    for pythons, ours in _PLAINLY.items():
        told = re.sub(pythons, ours, told)
    return told


def _usage(commands: dict[str, Command]) -> str:
    width = max(len(name) for name in commands)
    rows = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in commands.items())
    return (
        f"usage: uavrl COMMAND [options]\n\n{rows}\n\nuavrl COMMAND --help lists a command's options; uavrl --version"
    )


def _first_words() -> list[str]:
    return list(dict.fromkeys(name.split()[0] for name in COMMANDS))
