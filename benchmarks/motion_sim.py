# SPDX-License-Identifier: Apache-2.0
"""Plans executed in MuJoCo, judged by its contacts with the robot itself, the table and obstacles (N-11, N-12).

    python -m benchmarks.motion_sim [--plans 1000] [--both 200] [--beside 200] [--blind 20]
        [--profile openarm] [--first-seed 1000] [--runs FILE] [--json PATH]

Core and physics in one process, without DDS and faster than real time. Each scene is drawn from its seed: a table with
boxes on it and in the air, ten plans one after the other from wherever the arm stands. Trajectories go through the
bridge's own follower to the actuators; contacts are looked at after every step of the physics, the distance of the arms
ten milliseconds apart. The planner knows the boxes' sizes and poses and nothing of the judge. What is done already
(`--runs`, a line a scene) is not done again, so the command goes on where it was stopped. `off_path` is how far the
tool is from the reference by the joint states. `--blind` plans know nothing of the boxes in the air: they show that
the judge sees contacts.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.motion_problems import around_box, random_free, table_boxes
from benchmarks.motion_stand import FAR, Seen, Stand
from benchmarks.report import Row, write_report
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.draws import until
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_common.types import Array
from openarm_motion.collision.occupancy import Environment
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.coordination import ActiveMotion, least_delay
from openarm_motion.planning.dual_arm import DualArm, DualArmGoals, plan_staggered, plan_together
from openarm_motion.timing.trajectory import Trajectory
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig

#: Plans of one scene.
_A_SCENE = 10
#: Goals that are drawn for one plan before the scene is given up.
_DRAWS = 40
#: Distance from where the other arm will end that the motion node plans with, m.
_BESIDE = 0.035
#: Makes the simulated robot of a seed among boxes.
MakeStand = Callable[[tuple[Box, ...], int], Stand]
PROFILES: Mapping[str, HardwareConfig] = {"ideal": IDEAL, "openarm": HardwareConfig()}
#: Faults of a request that make another goal be drawn: drawn goals may well be out of reach or blocked.
_REFUSED = (Code.UNREACHABLE, Code.IN_COLLISION, Code.NO_PLAN, Code.LIMITS)


def scene_boxes(arms: Mapping[str, Arm], home: Mapping[str, float], rng: np.random.Generator) -> tuple[Box, ...]:
    """Boxes on the table and in the air, none of them at the robot's home."""
    boxes = list(table_boxes(rng, 5))
    for i in range(2):
        place, size = rng.uniform([0.25, -0.5, 0.55], [0.65, 0.5, 0.95]), rng.uniform(0.05, 0.15, 3)
        boxes.append(box_from(f"air{i}", place, size, se3.rot_z(float(rng.uniform(-3.0, 3.0)))))
    free: list[Box] = []
    for box in boxes:
        starts = [(arm, np.array([home[name] for name in arm.names])) for arm in arms.values()]
        if not any(arm.scene(home, [box]).collides(q) for arm, q in starts):
            free.append(box)
    return tuple(free)


def single(
    arm: Arm, state: dict[str, float], boxes: tuple[Box, ...], rng: np.random.Generator
) -> tuple[str, Trajectory]:
    """One random plan: to joints, to a pose next to a box, or along a line."""
    now = arm.start_state(state, scale=float(rng.choice([0.3, 0.5, 1.0])))
    around, kind = moves.RequestBoxes(boxes), str(rng.choice(["joints", "joints", "pose", "pose", "line"]))
    if kind == "joints":
        collides = arm.scene(state, boxes).collides
        return kind, moves.to_joints(arm, now, random_free(arm, rng, collides).tolist(), around)
    if kind == "pose":
        collides = arm.scene(state, boxes).collides
        found = around_box(arm, boxes[int(rng.integers(len(boxes)))], rng, collides, 1)
        if not found:
            raise OpenArmError(Code.UNREACHABLE, "no free pose next to that box")
        return kind, moves.to_pose(arm, now, arm.kinematics.fk(found[0]), around)
    pose = arm.kinematics.fk(now.start)
    pose[:3, 3] += rng.uniform(-0.15, 0.15, 3)
    return kind, moves.to_pose_on_line(arm, now, pose, around)


def run_blind(arms: Mapping[str, Arm], make: MakeStand, home: Mapping[str, float], seed: int) -> list[Seen]:
    """As `run_single`, without the boxes in the planner's eyes."""
    return run_single(arms, make, home, seed, blind=True)


def run_single(
    arms: Mapping[str, Arm], make: MakeStand, home: Mapping[str, float], seed: int, *, blind: bool = False
) -> list[Seen]:
    """The plans of one scene, the arms in turns."""
    rng = np.random.default_rng(seed)
    boxes = scene_boxes(arms, home, rng)
    known = tuple(box for box in boxes if not (blind and box.id.startswith("air")))
    stand, out = make(boxes, seed), list[Seen]()
    for k in range(_A_SCENE):
        arm, refused = list(arms.values())[k % 2], 0
        while refused < _DRAWS:
            begin = time.perf_counter()
            try:
                kind, plan = single(arm, stand.state(), known, rng)
            except OpenArmError as error:
                if error.code not in _REFUSED:
                    raise
                refused += 1
                continue
            seen = Seen(kind, planning=time.perf_counter() - begin, duration=plan.duration, refused=refused)
            stand.run({arm.name: plan}, seen, distances=False)
            out.append(seen)
            break
    return out


def run_both(arms: Mapping[str, Arm], make: MakeStand, home: Mapping[str, float], seed: int) -> list[Seen]:
    """Plans of both arms of one scene, together and staggered in turns."""
    rng = np.random.default_rng(seed)
    boxes = scene_boxes(arms, home, rng)
    stand, both, out = make(boxes, seed), DualArm(arms["left"], arms["right"]), list[Seen]()
    for k in range(_A_SCENE):
        refused = 0
        while refused < _DRAWS:
            state = stand.state()
            begin = time.perf_counter()
            goals = tuple(middle_goals(arm, state, boxes, rng) for arm in both.arms)
            now = StartState(state, np.array([state[name] for name in both.names]), float(rng.choice([0.3, 0.5, 1.0])))
            how = plan_staggered if k % 2 else plan_together
            try:
                plan = how(both, now, DualArmGoals((goals[0], goals[1]), boxes), 2.0)
            except OpenArmError as error:
                if error.code not in _REFUSED:
                    raise
                refused += 1
                continue
            seen = Seen(how.__name__, planning=time.perf_counter() - begin, refused=refused)
            seen.duration = max(part.duration for part in plan.trajectories)
            stand.run(dict(zip(("left", "right"), plan.trajectories, strict=True)), seen, distances=True)
            out.append(seen)
            break
    return out


def run_beside(arms: Mapping[str, Arm], make: MakeStand, home: Mapping[str, float], seed: int) -> list[Seen]:
    """Plans of one arm, made and begun while the other is under way, as the motion node does it."""
    rng = np.random.default_rng(seed)
    boxes = scene_boxes(arms, home, rng)
    stand, out = make(boxes, seed), list[Seen]()
    under_way: dict[str, tuple[Trajectory, int]] = {}
    nearest = FAR
    for k in range(2 * _A_SCENE):
        arm, other = list(arms.values())[:: 1 if k % 2 == 0 else -1]
        seen = Seen("beside", separation=nearest)
        while arm.name in stand.busy or (stand.busy and rng.random() > 0.02):
            stand.tick(seen, distances=True)
        under_way = {name: value for name, value in under_way.items() if name in stand.busy}
        for _ in range(_DRAWS):
            begin, state, held = time.perf_counter(), stand.state(), ActiveMotion.standing(other, stand.state())
            later = state
            if other.name in under_way:
                trajectory, since_ns = under_way[other.name]
                held = ActiveMotion(other, trajectory.later((since_ns - stand.world.t_ns) * 1e-9))
                later = {**state, **held.motion.joints_at(held.motion.duration)}
            goals = middle_goals(arm, later, boxes, rng)
            now = replace(
                arm.start_state(later, scale=float(rng.choice([0.3, 0.5, 1.0]))),
                environment=Environment(arm_clearance=_BESIDE),
            )
            try:
                scene = moves.free_scene(arm, now, moves.RequestBoxes(boxes))
                plan = arm.plan_validated(scene, now, goals, 2.0).trajectory
                wait = least_delay(ActiveMotion(arm, plan), [held], state)
            except OpenArmError as error:
                if error.code not in _REFUSED:
                    raise
                seen.refused += 1
                continue
            seen.planning, seen.duration = time.perf_counter() - begin, plan.duration
            stand.start(arm.name, plan, wait)
            under_way[arm.name] = (plan, stand.world.t_ns + round(wait * 1e9))
            out.append(seen)
            nearest = FAR
            break
        else:
            nearest = seen.separation
    while stand.busy:
        stand.tick(out[-1], distances=True)
    stand.close(out[-1])
    return out


def middle_goals(arm: Arm, state: dict[str, float], boxes: tuple[Box, ...], rng: np.random.Generator) -> Array:
    """Configurations with the hand in the space that both arms share, where it is free of the boxes."""
    alone = {**state, **dict.fromkeys((n for n in state if arm.name not in n), 0.0)}
    collides = arm.scene(alone, boxes).collides
    for _ in range(_DRAWS):
        R = se3.rot_z(float(rng.uniform(-3.0, 3.0))) @ se3.rot_x(float(np.pi - rng.uniform(0.0, 1.2)))
        pose = se3.make(R, rng.uniform([0.20, -0.25, 0.50], [0.45, 0.25, 0.85]))
        found = [s.q for s in arm.inverse.solutions(pose, arm.config.planning.joint_margin) if not collides(s.q)]
        if found:
            return np.array([found[i] for i in rng.permutation(len(found))[:6]])
    return random_free(arm, rng, collides)[None]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=1000, help="plans of one arm")
    parser.add_argument("--both", type=int, default=200, help="plans of both arms")
    parser.add_argument("--beside", type=int, default=200, help="plans of one arm while the other is under way")
    parser.add_argument("--blind", type=int, default=20, help="plans that know nothing of the boxes in the air")
    parser.add_argument("--profile", choices=list(PROFILES), default="ideal", help="motors of the arms; ten robots")
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--runs", type=Path, default=Path("runs/motion_sim.jsonl"), help="a line a scene; continued")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    plain = RobotDescription.load()
    home = {n: q for side in ("left", "right") for n, q in plain.group_state(f"{side}_arm", "home").items()}
    home |= {plain.finger_joint("left"): 0.0, plain.finger_joint("right"): 0.0}
    table = load_scene("empty").table
    static = [box_from("table", (*table.centre, table.top_z - 0.5 * table.thickness), table.extents)]
    robot = with_housings(plain, load_cameras().values())
    arms = {side: Arm(side, robot, MotionConfig(), static) for side in ("left", "right")}

    def make(boxes: tuple[Box, ...], seed: int) -> Stand:
        return Stand(plain, boxes, PROFILES[args.profile].of_seed(1 + seed % 10))

    args.runs.parent.mkdir(parents=True, exist_ok=True)
    done = _done(args.runs)
    rows: list[Row] = []
    for name, count, run in (
        ("n11", args.plans, run_single),
        ("n12", args.both, run_both),
        ("beside", args.beside, run_beside),
        ("blind", args.blind, run_blind),
    ):
        seen: list[Seen] = []
        seed = args.first_seed
        enough = partial(lambda seen, count: len(seen) >= count, seen, count)
        for _ in until(enough, f"plans of {name}", "see why each is refused", 100 * count):
            if (name, seed) not in done:
                found = run(arms, make, home, seed)
                with args.runs.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"what": name, "seed": seed, "plans": [asdict(s) for s in found]}) + "\n")
                done[name, seed] = found
                bad = sum(bool(s.contacts) or s.code != "OK" for s in found)
                print(f"{name} seed {seed}: {len(found)} plans, {bad} bad", flush=True)
            seen += done[name, seed]
            seed += 1
        rows += _rows(name, seen[:count])
    write_report(rows, args.json)


def _done(path: Path) -> dict[tuple[str, int], list[Seen]]:
    if not path.is_file():
        return {}
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {(line["what"], line["seed"]): [Seen(**plan) for plan in line["plans"]] for line in lines}


def _rows(name: str, seen: list[Seen]) -> list[Row]:
    if not seen:
        return []
    touched, n = [s for s in seen if s.contacts], len(seen)
    for s in touched:
        print(f"{name}: {s.kind}: {', '.join(s.contacts)}")
    failed = [s for s in seen if s.code != "OK"]
    for s in failed:
        print(f"{name}: {s.kind}: {s.code}")
    if name == "blind":
        return [Row("blind_contacts", len(touched), "", "higher", 1, n=n)]
    planning = np.array([s.planning for s in seen])
    rows = [
        Row(f"{name}_contacts", len(touched), "", "lower", 0, n=n),
        Row(f"{name}_failed", len(failed), "", "lower", 0, n=n),
        Row(f"{name}_refused_draws", sum(s.refused for s in seen), "", "lower", None, n=n),
        Row(f"{name}_plan_p95_ms", float(np.percentile(planning, 95)) * 1e3, "ms", "lower", None, n=n),
        Row(f"{name}_off_path_p95_mm", float(np.percentile([s.off for s in seen], 95)) * 1e3, "mm", "lower", None, n=n),
        Row(f"{name}_off_path_worst_mm", max(s.off for s in seen) * 1e3, "mm", "lower", None, n=n),
        Row(f"{name}_moved_s", sum(s.duration for s in seen), "s", "higher", None, n=n),
    ]
    if name in ("n12", "beside"):
        rows.append(Row(f"{name}_separation_mm", min(s.separation for s in seen) * 1e3, "mm", "higher", 20.0, n=n))
    return rows


if __name__ == "__main__":
    main()
