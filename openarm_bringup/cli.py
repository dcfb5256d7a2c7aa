# SPDX-License-Identifier: Apache-2.0
"""The command line: `openarm COMMAND`.

Commands are functions that return an `Outcome`; only here it is printed, written as JSON and turned into the exit
code. Modules of commands import heavy libraries inside their functions, so that `openarm --help` stays quick.
"""

from __future__ import annotations

import ast
import errno
import json
import os
import shutil
import sys
import textwrap
import threading
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from openarm_bringup.daemon.client import ask
from openarm_bringup.outcome import AT_END, FOR_PEOPLE, Outcome, failure
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import printable_lines

if TYPE_CHECKING:
    from cyclopts import App

#: Commands of the package that evaluates. It imports this one, which therefore knows it by name only.
EVALUATION = "openarm_evaluation.commands"

HELP = """Vision-guided grasping for the OpenArm robot.

`openarm demo` shows all of it; `openarm up` starts the node graph, `openarm pick red` requests a grasp."""
EPILOGUE = """Every command takes `--json [PATH]`: the outcome as JSON, on stdout or in PATH (a name ending in .json).
Exit code 0: what was asked happened. 1: it did not; a code and a sentence say why. 2: the call was wrong."""


#: Commands by group of the help: a module and its function or App. They are imported when they are needed.
COMMANDS = {
    "Run": (f"{EVALUATION}.demo:demo", "up:up", "view:view", "stop:stop", "calibrate:calibrate"),
    "Grasp": ("pick:pick", "pick:order", f"{EVALUATION}.campaign:campaign"),
    "Inspect": ("processes:ps", "processes:logs", "doctor:doctor", "tf:tf", "hardware:hardware"),
    "Messages": ("ros2:topic", "ros2:service", "ros2:action", "ros2:node", "ros2:param"),
    "Record and check": ("perceive:perceive", "record:record", "record:replay", "record:check"),
    "Models and graphs": (
        "model:model",
        "graph:graph",
        "grasp:grasp",
        f"{EVALUATION}.detector:detector",
        f"{EVALUATION}.objects:objects",
    ),
    "Develop": ("checks:test", "checks:lint", f"{EVALUATION}.chaos:chaos", "checks:completion"),
}


#: Faults of a disk, which are none of the program.
_OF_DISKS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
#: Held while a call is read: the groups of commands are shared by all requests to a daemon.
_READING = threading.Lock()


def build_app() -> App:
    """Return the application with all its commands."""
    from cyclopts import App, Group, Parameter

    app = App(
        name="openarm",
        help=HELP,
        help_epilogue=EPILOGUE,
        help_format="markdown",
        version=_version,
        default_parameter=Parameter(negative=(), negative_iterable=()),
    )
    for number, (title, commands) in enumerate(COMMANDS.items()):
        group = Group(title, sort_key=number)
        for command in commands:
            app.command(_path(command), group=group)
    options = Group("Options", sort_key=len(COMMANDS))
    for flag in ("--help", "--version"):
        app[flag].group = options
    return app


def _path(command: str) -> str:
    return command if "." in command else f"openarm_bringup.commands.{command}"


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code."""
    tokens, sink = take_json(argv)
    before = FOR_PEOPLE.set(sink != "-")
    try:
        return _run(tokens, sink)
    finally:
        FOR_PEOPLE.reset(before)


def _place_on(tokens: Sequence[str]) -> list[str]:
    """Return a command line whose `--place on:THING` or `in:THING`, of one word, has an option of its own."""
    found = list[str]()
    for before, word in zip(("", *tokens), tokens, strict=False):
        if before == "--place" and word.startswith(("on:", "in:")):
            found[-1:] = ["--place-on", word[3:]]
        else:
            found.append(word)
    return found


def _run(tokens: Sequence[str], sink: str | None) -> int:
    if not tokens or tokens[0] in ("--help", "-h"):
        _print(_help())
        return 0
    from cyclopts import CycloptsError

    try:
        with _READING:
            command, bound, _ = build_app().parse_args(_place_on(tokens), exit_on_error=False, print_error=False)
        result = command(*bound.args, **bound.kwargs)
    except CycloptsError as error:
        return _refuse(str(error), Code.INVALID_ARGUMENT, sink)
    except OpenArmError as error:
        if error.code == Code.INVALID_ARGUMENT:
            return _refuse(error.message, error.code, sink)
        result = failure(error)
    except OSError as error:
        if error.errno not in _OF_DISKS:
            raise
        result = failure(OpenArmError(Code.ENVIRONMENT, f"can't write {error.filename or 'a file'}: {error.strerror}"))
    except KeyboardInterrupt:
        result = Outcome(False, "stopped by Ctrl-C", Code.CANCELLED)
    if not isinstance(result, Outcome):  # --help and --version have printed
        return 0
    return _show(result, sink)


def _help() -> str:
    """Return the list of all commands, by what their files say: to import them would take longer than to read it."""
    lines = ["Usage: openarm COMMAND", "", HELP, ""]
    width = min(shutil.get_terminal_size().columns, 120)
    for title, commands in COMMANDS.items():
        lines.append(f"{title}:")
        for name, summary in sorted(map(_summary, commands)):
            lines += textwrap.wrap(f"  {name:<11}{summary}", width, subsequent_indent=" " * 13)
        lines.append("")
    lines.append("`openarm COMMAND --help` says more; `openarm --version` prints the version.")
    return "\n".join([*lines, *textwrap.wrap(EPILOGUE, width)])


def _summary(command: str) -> tuple[str, str]:
    """Return the name of a command, and the first sentence of its docstring, or the help of a group."""
    module, _, target = _path(command).partition(":")
    spec = find_spec(module)
    for node in ast.parse(Path(str(spec and spec.origin)).read_bytes()).body:
        if isinstance(node, ast.FunctionDef) and node.name == target:
            return target, " ".join((ast.get_docstring(node) or "").partition("\n\n")[0].split())
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and ast.unparse(node.targets[0]) == target:
            words = {word.arg: ast.literal_eval(word.value) for word in node.value.keywords if word.arg == "help"}
            return target, words["help"]
    raise AttributeError(f"{module} has no {target}")


def take_json(argv: Sequence[str]) -> tuple[list[str], str | None]:
    """Split `--json [PATH]` off; the sink is None (not asked for), "-" (stdout) or a path.

    A value is taken as the path only when it ends in .json or is "-": in `--json pick red`, `pick` is the command.
    """
    tokens = list(argv)
    rest = tokens.index("--") if "--" in tokens else len(tokens)
    for index, token in enumerate(tokens[:rest]):
        if token.startswith("--json="):
            return tokens[:index] + tokens[index + 1 :], token.removeprefix("--json=") or "-"
        if token == "--json":
            after = tokens[index + 1] if index + 1 < rest else ""
            if after == "-" or after.endswith(".json"):
                return tokens[:index] + tokens[index + 2 :], after
            return tokens[:index] + tokens[index + 1 :], "-"
    return tokens, None


def _show(outcome: Outcome, sink: str | None) -> int:
    """Show how a command ended; return its exit code."""
    if sink == "-":
        _print(json.dumps(outcome.as_json(), indent=2, default=str))
        return outcome.exit_code
    if sink is not None:
        from openarm_bringup.supervision import runs

        try:
            runs.write_json(Path(sink), outcome.as_json())
        except OpenArmError as error:
            text = "; ".join(filter(None, (outcome.message, error.message)))
            outcome = replace(outcome, success=False, code=error.code, message=text)
    if outcome.text:
        _print(printable_lines(outcome.text))
    if outcome.success:
        if outcome.message:
            _print(printable_lines(outcome.message, "  "))
    else:
        sys.stderr.write(f"openarm: {outcome.code}: {printable_lines(outcome.message, '  ')}\n")
    return outcome.exit_code


def _refuse(message: str, code: Code, sink: str | None) -> int:
    _show(Outcome(False, message, code), sink)
    return 2


def _print(text: str) -> None:
    sys.stdout.write(text.rstrip("\n") + "\n")
    sys.stdout.flush()


def _version() -> str:
    from openarm_bringup.versions import versions

    return versions(("openarm-vision",))["openarm-vision"]


def _ask(argv: Sequence[str]) -> int | None:
    try:
        return ask(argv)
    except OpenArmError as error:
        _show(failure(error), take_json(argv)[1])
        return 1


def main() -> None:
    """Run the command line of this process."""
    argv = sys.argv[1:]
    try:
        code = _ask(argv)
        if code is None:
            code = run(argv)
        sys.stdout.flush()
    except BrokenPipeError:  # as in `openarm topic echo ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    for last in AT_END:
        last(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
