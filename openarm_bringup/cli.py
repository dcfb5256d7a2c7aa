# SPDX-License-Identifier: Apache-2.0
"""The command line: `openarm COMMAND`.

Commands are functions that return an `Outcome`; only here it is printed, written as JSON and turned into the exit
code. Modules of commands import heavy libraries inside their functions, so that `openarm --help` stays quick.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import cyclopts
from cyclopts import App, Group, Parameter

from openarm_bringup.outcome import FOR_PEOPLE, Outcome, failure
from openarm_common.errors import Code, OpenArmError

#: Commands of the package that evaluates. It imports this one, which therefore knows it by name only.
EVALUATION = "openarm_evaluation.commands"

HELP = """Vision-guided grasping for the OpenArm robot.

`openarm demo` shows all of it; `openarm up` starts the node graph, `openarm pick red` requests a grasp."""
EPILOGUE = """Every command takes `--json [PATH]`: the outcome as JSON, on stdout or in PATH (a name ending in .json).
Exit code 0: what was asked happened. 1: it did not; a code and a sentence say why. 2: the call was wrong."""


#: Commands by group of the help: a module and its function or App. They are imported when they are needed.
COMMANDS = {
    "Run": (f"{EVALUATION}.demo:demo", "up:up", "view:view", "calibrate:calibrate"),
    "Grasp": ("pick:pick", "pick:order", f"{EVALUATION}.campaign:campaign"),
    "Inspect": ("processes:ps", "processes:logs", "doctor:doctor", "tf:tf"),
    "Messages": ("ros2:topic", "ros2:service", "ros2:action", "ros2:node", "ros2:param"),
    "Record and check": ("record:record", "record:replay", "record:check"),
    "Models and graphs": ("model:model", "graph:graph", "grasp:grasp", f"{EVALUATION}.detector:detector"),
    "Develop": ("checks:test", "checks:lint", "checks:completion"),
}


def build_app() -> App:
    """Return the application with all its commands."""
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
            app.command(command if "." in command else f"openarm_bringup.commands.{command}", group=group)
    options = Group("Options", sort_key=len(COMMANDS))
    for flag in ("--help", "--version"):
        app[flag].group = options
    return app


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code."""
    tokens, sink = take_json(argv)
    before = FOR_PEOPLE.set(sink != "-")
    try:
        return _run(tokens, sink)
    finally:
        FOR_PEOPLE.reset(before)


def _run(tokens: Sequence[str], sink: str | None) -> int:
    app = build_app()
    if not tokens or tokens[0] in ("--help", "-h"):
        for name in list(app):
            _ = app[name]  # imported, so that its summary is listed
    try:
        result = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
    except cyclopts.CycloptsError as error:
        return _refuse(str(error), Code.INVALID_ARGUMENT, sink)
    except OpenArmError as error:
        if error.code == Code.INVALID_ARGUMENT:
            return _refuse(error.message, error.code, sink)
        result = failure(error)
    except KeyboardInterrupt:
        result = Outcome(False, "stopped by Ctrl-C", Code.CANCELLED)
    if not isinstance(result, Outcome):  # --help and --version have printed
        return 0
    _show(result, sink)
    return result.exit_code


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


def _show(outcome: Outcome, sink: str | None) -> None:
    if sink == "-":
        _print(json.dumps(outcome.as_json(), indent=2, default=str))
        return
    if sink is not None:
        from openarm_bringup.supervision import runs

        runs.write_json(Path(sink), outcome.as_json())
    if outcome.text:
        _print(outcome.text)
    if outcome.success:
        if outcome.message:
            _print(outcome.message)
    else:
        sys.stderr.write(f"openarm: {outcome.code}: {outcome.message}\n")


def _refuse(message: str, code: Code, sink: str | None) -> int:
    _show(Outcome(False, message, code), sink)
    return 2


def _print(text: str) -> None:
    sys.stdout.write(text.rstrip("\n") + "\n")
    sys.stdout.flush()


def _version() -> str:
    from openarm_bringup.versions import versions

    return versions(("openarm-vision",))["openarm-vision"]


def main() -> None:
    """Run the command line of this process."""
    try:
        code = run(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # as in `openarm topic echo ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code)


if __name__ == "__main__":
    main()
