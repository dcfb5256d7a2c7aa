# SPDX-License-Identifier: Apache-2.0
"""The command line: `openarm COMMAND`.

Commands are functions that return an `Outcome`; here alone it is printed, written as JSON and turned into the exit
code. Modules of commands import heavy libraries inside their functions, so that `openarm --help` stays quick.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import cyclopts
from cyclopts import App, Group, Parameter

from openarm_bringup.outcome import FOR_PEOPLE, Outcome, failure
from openarm_bringup.supervision import runs
from openarm_common.errors import Code, OpenArmError

#: Commands of the package that evaluates; it imports this one, which therefore names it here alone.
EVALUATION = "openarm_evaluation.commands"

HELP = """Eyes and hands for the OpenArm robot.

`openarm demo` shows all of it; `openarm up` starts the node graph, `openarm pick red` asks it for a grasp."""
EPILOGUE = """Every command takes `--json [PATH]`: the outcome as JSON, on stdout or in PATH (a name ending in .json).
Exit code 0: what was asked happened. 1: it did not; a code and a sentence say why. 2: the call was wrong."""


def build_app() -> App:
    """Return the application with all its commands."""
    from openarm_bringup.commands import (
        calibrate,
        checks,
        completion,
        doctor,
        graph,
        grasp,
        model,
        order,
        param,
        pick,
        processes,
        record,
        ros2,
        tf,
        up,
        view,
    )

    demo, campaign, detector = (import_module(f"{EVALUATION}.{name}") for name in ("demo", "campaign", "detector"))
    app = App(
        name="openarm",
        help=HELP,
        help_epilogue=EPILOGUE,
        help_format="markdown",
        version=_version,
        default_parameter=Parameter(negative_iterable=()),
    )
    groups: dict[str, tuple[App | Callable[..., Outcome], ...]] = {
        "Run": (demo.demo, up.up, view.view, calibrate.app),
        "Ask for grasps": (pick.pick, order.order, campaign.campaign),
        "Look inside": (processes.ps, processes.logs, doctor.doctor, tf.app),
        "Messages": (ros2.topic, ros2.service, ros2.action, ros2.node, param.app),
        "Record and check": (record.record, record.replay, record.check),
        "Models and graphs": (model.model, graph.app, grasp.app, detector.app),
        "Develop": (checks.test, checks.lint, completion.completion_of(app)),
    }
    for number, (title, commands) in enumerate(groups.items()):
        group = Group(title, sort_key=number)
        for command in commands:
            if isinstance(command, App):
                command.group = group
                app.command(command)
            else:
                app.command(command, group=group)
    options = Group("Options", sort_key=len(groups))
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

    A value is taken as the path only when it ends in .json or is "-", so that `--json pick red` means what it says.
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
        runs.write_json(Path(sink), outcome.as_json())
    if outcome.text:
        _print(outcome.text)
    if outcome.success:
        if outcome.message:
            _print(outcome.message)
    else:
        _complain(f"{outcome.code}: {outcome.message}")


def _refuse(message: str, code: Code, sink: str | None) -> int:
    _show(Outcome(False, message, code), sink)
    return 2


def _print(text: str) -> None:
    sys.stdout.write(text.rstrip("\n") + "\n")
    sys.stdout.flush()


def _complain(text: str) -> None:
    sys.stderr.write(f"openarm: {text}\n")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("openarm-vision")
    except PackageNotFoundError:
        return "unknown (run from a checkout that is not installed)"


def main() -> None:
    """Run the command line of this process."""
    try:
        code = run(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # who reads has read enough, as `openarm topic echo ... | head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code)


if __name__ == "__main__":
    main()
