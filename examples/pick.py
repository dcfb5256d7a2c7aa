# SPDX-License-Identifier: Apache-2.0
"""Pick an object by its label with the Python client: ``.venv/bin/python examples/pick.py red``."""

from __future__ import annotations

import sys

from openarm_grasp import GraspClient


def main() -> int:
    """Ask for a grasp and print its states; 0 when the object stands at its place."""
    label = sys.argv[1] if len(sys.argv) > 1 else "red"
    with GraspClient() as grasp:
        result = grasp.pick(label, on_feedback=lambda status: print(status.state, status.reason))
    print(result.code, result.message)
    return 0 if result.success else 1


if __name__ == "__main__":
    sys.exit(main())
