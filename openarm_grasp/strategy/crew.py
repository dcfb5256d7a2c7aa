# SPDX-License-Identifier: Apache-2.0
"""The two machines of a robot with two hands: both serve two requests at once, and one of them each single request."""

from __future__ import annotations

from openarm_grasp.strategy.effects import GraspRequest
from openarm_grasp.strategy.machine import GraspMachine
from openarm_grasp.strategy.memory import Surroundings
from openarm_grasp.strategy.performer import Performer


class Crew:
    """What the machines have in common: the watch on the camera, and what their requests left in the hands.

    Args:
        around: Parameters, table and arms.
    """

    def __init__(self, around: Surroundings) -> None:
        first = GraspMachine(around)
        self.machines = (first, GraspMachine(around, first.drift))

    @property
    def running(self) -> tuple[str, ...]:
        """What is being picked; "" for any object."""
        return tuple(machine.label for machine in self.machines if machine.memory is not None)

    def check_hands(self, performer: Performer, request: GraspRequest) -> None:
        """Refuse what would drop an object that an ended request left in either hand.

        Raises:
            OpenArmError: NOT_READY.
        """
        for machine in self.machines:
            performer.check_hands(machine, request)

    def serving(self, request: GraspRequest) -> GraspMachine:
        """The machine that carries out a single request: it knows what is to be placed, or else is the first."""
        first = self.machines[0]
        if request.phase != "place":
            return first
        holding = [machine for machine in self.machines if machine.kept is not None]
        meant = (m for m in holding if m.kept and request.label in ("", m.kept.target.label))
        fitting = (m for m in meant if request.arm in ("", "auto", m.carrying))
        return next(fitting, holding[0] if holding else first)

    def full_hands_beside(self, machine: GraspMachine) -> tuple[str, ...]:
        """Arms whose hand keeps something that is not this machine's affair: they must stay where they are."""
        return tuple(other.carrying for other in self.machines if other is not machine and other.carrying)
