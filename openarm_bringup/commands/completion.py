# SPDX-License-Identifier: Apache-2.0
"""`openarm completion`: the shell completes commands, options and their choices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from cyclopts import App, Parameter

from openarm_bringup.outcome import Outcome


def completion_of(app: App) -> Callable[..., Outcome]:
    """Return the command for an application."""

    def completion(
        shell: Literal["bash", "zsh", "fish"] = "bash", *, install: Annotated[bool, Parameter(negative=())] = False
    ) -> Outcome:
        """Print what makes a shell complete this command line, as in: eval "$(openarm completion bash)".

        Args:
            shell: Which shell.
            install: Write it where the shell finds it, for every new shell, instead of printing it.
        """
        if install:
            path = app.install_completion(shell=shell)
            return Outcome(True, f"written to {path}; new shells complete `openarm`", data={"path": str(path)})
        script = app.generate_completion(shell=shell)
        return Outcome(True, data={"shell": shell, "script": script}, text=script)

    return completion
