# SPDX-License-Identifier: Apache-2.0
"""What a campaign runs, and the command that runs one row of it again."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from cyclopts import Parameter, Token
from cyclopts.validators import Number

from openarm_bringup.commands.connect import Robot
from openarm_common.camera.cameras import detector_nodes
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import DEFAULT, robot_name, robot_source
from openarm_evaluation.campaign.tasks.things import THINGS
from openarm_perception.detection.kinds import DetectorKind
from openarm_sim_bridge.config import FaceName, Profile

Row = dict[str, Any]


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of `A-B`, `A` or a list such as `1,4,7-9`.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    seeds: list[int] = []
    for part in text.split(","):
        low, dash, high = part.strip().partition("-")
        if not low.isdecimal() or (dash and not high.isdecimal()) or (dash and int(high) < int(low)):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"seeds {text!r}: expected numbers such as 0-19, 3 or 1,4,7-9")
        seeds += range(int(low), int(high if dash else low) + 1)
    return tuple(seeds)


def _from_command_line(_: object, tokens: Sequence[Token]) -> tuple[int, ...]:
    return parse_seeds(tokens[0].value)


def _detectors(_: object, tokens: Sequence[Token]) -> tuple[DetectorKind, ...]:
    kinds = tuple(dict.fromkeys(tokens[0].value.split(",")))
    known: tuple[DetectorKind, ...] = get_args(DetectorKind)
    if wrong := [kind for kind in kinds if kind not in known]:
        text = f"detectors {', '.join(map(repr, wrong))} do not exist; there are {', '.join(known)}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    return tuple(kind for kind in known if kind in kinds)


Seeds = Annotated[tuple[int, ...], Parameter(converter=_from_command_line, n_tokens=1, show_default=False)]

Detectors = Annotated[tuple[DetectorKind, ...], Parameter(converter=_detectors, n_tokens=1, show_default=False)]


@Parameter(name="*")
@dataclass(frozen=True)
class CampaignOptions:
    """What a campaign runs.

    Args:
        set_name: nominal, clutter, faults, endurance, handover, push, pairs, pairs_in_turn, orders, objects, heap or
            supports; --set NAME means the same.
        seeds: One task each, such as 0-99 or 1,4,7-9; 0-9 when not given.
        workers: Processes.
        noise: Depth as noisy as a D435's.
        mount_seeds: True camera mounts to go through, such as 1-10; each is calibrated first. Nominal when not given.
        profile: Motors of the arms: openarm as owners have them, or ideal.
        hardware: simulated, or emulated: openarm_hardware before motors that take frames, through the graph alone.
        dynamics_seeds: Motors, masses and joint zeros to go through with the profile openarm, such as 1-10.
        controllers: Controllers of the robot: suite, or openarm_ros2 with the profile openarm, through the graph alone.
        hand_seeds: Stops and friction of the fingers to go through, such as 1-10; each hand is learned first. Those of
            the drawing when not given.
        identify: Whether the servos of each draw are identified first.
        use_effort: Whether the force of the fingers counts as evidence.
        objects: Of the suites objects and heap: a folder of object folders, or superquadrics:N; those of models/objects
            when not given.
        detector: Detector of objects: their colour, the network, both checking each other, a tag on them, or depth
            (anything). Colour, and depth in the suites objects and heap, when not given.
        parameters: A parameter of a node of the graph `sim`, as node.param=value; may be given several times.
        ray: Address of a Ray cluster, such as HOST:6379 or auto, whose machines run the workers.
    """

    set_name: Annotated[str, Parameter(name="--suite")] = "nominal"
    seeds: Seeds = tuple(range(10))
    workers: Annotated[int, Parameter(validator=Number(gte=1))] = 1
    noise: bool = False
    mount_seeds: Seeds = ()
    profile: Profile = "openarm"
    controllers: FaceName = "suite"
    hardware: Literal["simulated", "emulated"] = "simulated"
    dynamics_seeds: Seeds = (1,)
    hand_seeds: Seeds = ()
    identify: Annotated[bool, Parameter(negative="--no-identify")] = True
    use_effort: Annotated[bool, Parameter(name="--effort", negative="--no-effort")] = True
    objects: str = ""
    detector: DetectorKind | None = None
    parameters: Annotated[tuple[str, ...], Parameter(name="--set")] = ()
    ray: str = ""
    robot: Robot = None

    def __post_init__(self) -> None:
        """Take a `--set` without a value for the name of the suite.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when two suites are named.
        """
        suites = [item for item in self.parameters if "=" not in item and "." not in item]
        if self.set_name != "nominal":
            suites.insert(0, self.set_name)
        if len(set(suites)) > 1:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"one suite at a time, got {' and '.join(map(repr, suites))}")
        parameters = tuple(item for item in self.parameters if item not in suites)
        object.__setattr__(self, "set_name", suites[0] if suites else self.set_name)
        object.__setattr__(self, "parameters", parameters)

    @property
    def emulated(self) -> bool:
        """Whether the robot is met by the frames of its motors."""
        return self.hardware == "emulated"

    @property
    def finder(self) -> DetectorKind:
        """What finds objects, where nothing is said: depth alone in suites of any shape."""
        return self.detector or self._usual_finder

    @property
    def _usual_finder(self) -> DetectorKind:
        return "anything" if self.set_name in THINGS else "color"

    def settings(self) -> dict[str, Any]:
        """What must be the same for rows to belong together."""
        return {
            "set": self.set_name,
            "robot": robot_name(),
            "noise": self.noise,
            "mount_seeds": list(self.mount_seeds),
            **self._profile_settings(),
            **({"hand_seeds": list(self.hand_seeds)} if self.hand_seeds else {}),
            "use_effort": self.use_effort,
            **({"objects": self.objects} if self.objects else {}),
            **({"detector": self.finder} if self.finder != "color" else {}),
            **({"parameters": list(self.parameters)} if self.parameters else {}),
        }

    def _profile_settings(self) -> dict[str, Any]:
        if self.profile == "ideal":
            return {}
        face = {"controllers": self.controllers} if self.controllers != "suite" else {}
        face |= {"hardware": self.hardware} if self.emulated else {}
        seeds = list(self.dynamics_seeds)
        return {"profile": self.profile, **face, "dynamics_seeds": seeds, "identify": self.identify}

    def graph_parameters(self) -> tuple[str, ...]:
        """Return the parameters of the graph that the options stand for, as `node.param=value`."""
        return (
            f"mujoco_bridge.depth_noise.enabled={str(self.noise).lower()}",
            f"mujoco_bridge.profile={self.profile}",
            f"grasp.held.use_effort={str(self.use_effort and self.controllers == 'suite').lower()}",
            *(f"{node}.detector={self.finder}" for node in detector_nodes().values()),
            *self.parameters,
        )

    def command(self, seed: int) -> str:
        """The command that runs one row again."""
        parts = [
            "./openarm campaign",
            f"--suite {self.set_name}" if self.set_name != "nominal" else "",
            f"--seeds {seed}",
            f"--robot {robot_source()}" if robot_source() != DEFAULT else "",
        ]
        parts.append("--noise" if self.noise else "")
        parts.append("--mount-seeds " + ",".join(map(str, self.mount_seeds)) if self.mount_seeds else "")
        parts.append("--hand-seeds " + ",".join(map(str, self.hand_seeds)) if self.hand_seeds else "")
        if self.profile == "ideal":
            parts.append("--profile ideal")
        else:
            parts.append("--dynamics-seeds " + ",".join(map(str, self.dynamics_seeds)))
            parts.append("" if self.controllers == "suite" else f"--controllers {self.controllers}")
            parts.append("--hardware emulated" if self.emulated else "")
            parts.append("" if self.identify else "--no-identify")
        parts.append("" if self.use_effort else "--no-effort")
        parts.append(f"--objects {shlex.quote(self.objects)}" if self.objects else "")
        parts.append(f"--detector {self.finder}" if self.finder != self._usual_finder else "")
        parts += [f"--set {shlex.quote(item)}" for item in self.parameters]
        return " ".join(part for part in parts if part)
