# SPDX-License-Identifier: Apache-2.0
"""Motors of an arm on CAN: a process that commands them at 250 Hz, and the node before it in `ros/`.

Example:
    >>> from openarm_hardware import Settings
    >>> Settings().period_s
    0.004
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_hardware.arm import ArmMachine as ArmMachine
    from openarm_hardware.client import ServoProcess as ServoProcess
    from openarm_hardware.driver import MotorDriver as MotorDriver
    from openarm_hardware.exchange import Command as Command
    from openarm_hardware.machine import Machine as Machine
    from openarm_hardware.settings import Settings as Settings

__getattr__, __dir__ = attach(__name__, __file__)
