# SPDX-License-Identifier: Apache-2.0
"""`openarm record`, `openarm replay`: topics of a graph to a bag and back."""

from __future__ import annotations

import os
import shutil
import time
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from openarm_bringup.commands.connect import Domain, join_graph, stop_event
from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code, OpenArmError


def record(
    bag: Path | None = None,
    *,
    profile: Literal["grasp", "camera", "all"] = "grasp",
    topics: tuple[str, ...] = (),
    duration: float = 0.0,
    image_rate: float = 0.0,
    domain: Domain = None,
) -> Outcome:
    """Record topics of the running graph until Ctrl-C, to a rosbag2 folder (MCAP, zstd).

    Args:
        bag: Folder to make; bag_DATE_TIME when not given.
        profile: Topics to record: grasp (cameras, robot, detections, grasp), camera (cameras, robot), all.
        topics: Regular expressions of topic names, instead of a profile.
        duration: End after this long, s of wall clock; 0 waits for Ctrl-C.
        image_rate: Keep at most this many frames a second of each camera; 0 keeps all.
    """
    join_graph(domain)
    from openarm_bringup.bags.ros.listener import profiles
    from openarm_bringup.bags.ros.recorder import Recorder

    path = bag or Path(datetime.now().strftime("bag_%Y%m%d_%H%M%S"))
    number = int(os.environ.get("ROS_DOMAIN_ID") or "0")
    with (
        stop_event() as stop,
        Recorder(number, path, topics or profiles()[profile], _about(number), image_rate) as recorder,
    ):
        while not stop.is_set() and not recorder.wait_began(0.2):
            pass
        topics_now = f"{len(recorder.topics)} topics" if recorder.topics else "topics that will be published"
        console().print(f"recording {topics_now} to {path}; Ctrl-C ends it", markup=False, soft_wrap=True)
        deadline = time.monotonic() + (duration or float("inf"))
        while (left := deadline - time.monotonic()) > 0.0 and not stop.is_set():
            if not recorder.wait(min(0.2, left)):
                break
    recorded = recorder.recorded
    data: dict[str, Any] = {
        "bag": str(path),
        "messages": sum(recorded.counts.values()),
        "lost": sum(recorded.lost.values()),
        "topics": dict(sorted(recorded.counts.items())),
        "lost_topics": dict(recorded.lost.most_common()),
        "bytes": sum(file.stat().st_size for file in path.glob("*")),
    }
    rows = [f"{recorded.counts[t]:8d}  {recorded.lost[t]:8d}  {t}" for t in sorted({*recorded.counts, *recorded.lost})]
    text = "\n".join([f"{'recorded':>8}  {'lost':>8}  topic", *rows])
    if recorded.ended:
        message = f"recording ended early: {recorded.ended}; {data['messages']} messages are in {path}"
        return Outcome(False, message, Code.ENVIRONMENT, data, text)
    if not recorded.counts:
        shutil.rmtree(path)  # made by this recording; a second try may have the name
        message = f"no message came; topics that match: {', '.join(recorder.topics) or 'none'}. Is a graph running?"
        return Outcome(False, message, Code.NOTHING_DETECTED, data)
    message = f"{data['messages']} messages, {data['bytes'] / 1e6:.1f} MB in {path}, {data['lost']} lost"
    if data["lost"]:
        worst = ", ".join(f"{count} of {topic}" for topic, count in recorded.lost.most_common(3))
        advice = (
            "record fewer topics (--profile, --topics) or fewer frames (--image-rate), or give it a quieter machine"
        )
        return Outcome(False, f"{message} ({worst}); {advice}", Code.LIMITS, data, text)
    return Outcome(True, message, data=data, text=text)


def replay(
    bag: Path,
    *,
    rate: float = 1.0,
    clock: bool = False,
    start: float = 0.0,
    duration: float = 0.0,
    loop: bool = False,
    topics: tuple[str, ...] = (),
    remap: tuple[str, ...] = (),
    until_idle: bool = False,
    domain: Domain = None,
) -> Outcome:
    """Publish a bag in place of the robot, in the order and with the quality of service in which it was recorded.

    Args:
        bag: Folder of rosbag2, with metadata.yaml or without, or one file of it: .mcap or .db3.
        rate: Times real time; 0 is as fast as subscribers take it.
        clock: Publish /clock from the stamps of the bag, when it holds none.
        start: Begin this long after the first message, s; latched topics of before are published first.
        duration: End after this much of the bag, s; 0 plays all.
        loop: Begin again at the end, until Ctrl-C.
        topics: Only these.
        remap: FROM:=TO of topic names; may be given several times.
        until_idle: Wait at the end until what the graph publishes has ceased for a second.
    """
    if rate < 0.0 or start < 0.0 or duration < 0.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--rate, --start, --duration: 0 or more, got {rate, start, duration}"
        )
    from openarm_bringup.bags.about import require_robot
    from openarm_bringup.bags.bag import listed, open_bag

    names = dict(_split(pair) for pair in remap)
    with open_bag(bag) as opened:
        unknown = sorted(set(topics) - set(opened.topics))
        if unknown:
            known = ", ".join(sorted(opened.topics))
            raise OpenArmError(Code.INVALID_ARGUMENT, f"not in {bag}: {', '.join(unknown)}; topics: {known}")
        join_graph(domain)
        require_robot(opened)
        from openarm_bringup.bags.ros.player import Player

        with stop_event() as stop, Player(opened, topics or None, names, clock=clock) as player:
            while True:
                player.play(rate, start, duration, stop)
                if not loop or stop.is_set():
                    break
            if until_idle and not stop.is_set():
                player.wait_idle(1.0, 60.0)
        mended = f"; it was cut short: {opened.mended} bytes at its end were not whole" if opened.mended else ""
    data = {"bag": str(bag), "messages": player.published, "late_ms": player.late_ms}
    data |= {"left_out": player.left_out, "left_to_graph": player.left}
    if stop.is_set():
        return Outcome(False, f"stopped after {player.published} messages", Code.CANCELLED, data)
    left = f"; left to the graph, which makes them itself: {', '.join(player.left)}" if player.left else ""
    left += f"; left out: {listed(player.left_out)}" if player.left_out else ""
    if player.published == 0:
        return Outcome(False, f"nothing to replay in {bag}{mended}{left}", Code.NOTHING_DETECTED, data)
    return Outcome(True, f"{player.published} messages of {bag}{mended}{left}", data=data)


def check(bag: Path, *, golden: Path | None = None, scene: str = "demo", update: bool = False) -> Outcome:
    """Run detection, map and board detection on a bag, and compare with golden numbers; for CI. Needs no graph.

    A flight recording has none, so its reason and its numbers are shown.

    Args:
        bag: Folder of rosbag2, with metadata.yaml or without, or one file of it: .mcap or .db3.
        golden: File with the numbers that are expected; golden.json in the bag's folder when not given.
        scene: Scene whose table the objects stand on.
        update: Write the numbers instead of comparing.
    """
    from openarm_bringup.bags import golden as stored
    from openarm_bringup.bags.about import require_robot
    from openarm_bringup.bags.bag import listed, open_bag
    from openarm_bringup.bags.ros.bag import numbers_of
    from openarm_bringup.progress import progress

    path = golden or (bag if bag.is_dir() else bag.parent) / "golden.json"
    with open_bag(bag) as opened, progress() as shown:
        require_robot(opened)
        # A flight recording shows what went wrong; nobody knows beforehand which numbers it should give.
        shown_only = not update and golden is None and not path.exists() and "reason" in opened.custom
        expected = {} if shown_only or (update and not path.exists()) else stored.read(path)
        kept = {name: opened.custom[name] for name in ("reason", "request", "again") if name in opened.custom}
        task = shown.add_task("frames", total=None)
        numbers = numbers_of(opened, scene=scene, on_progress=lambda n, of: shown.update(task, completed=n, total=of))
    data: dict[str, Any] = {"bag": str(bag), "golden": str(path), "numbers": numbers, **kept}
    data["left_out"] = opened.left_out
    left = f"; left out of the bag: {listed(opened.left_out)}" if opened.left_out else ""
    if shown_only:
        text = "\n".join(f"{name}: {value}" for name, value in {**kept, **numbers}.items())
        return Outcome(
            True, f"{len(numbers)} numbers of {bag}; --update stores them to compare with{left}", data=data, text=text
        )
    if update:
        stored.write(path, numbers, expected)
        return Outcome(True, f"{len(numbers)} numbers written to {path}{left}", data=data)
    differences = stored.compare(expected, numbers)
    data["differences"] = [str(difference) for difference in differences]
    if differences:
        message = f"{len(differences)} of {len(expected)} numbers differ from {path}{left}"
        return Outcome(False, message, Code.STALE_DATA, data, "\n".join(data["differences"]))
    return Outcome(True, f"{len(numbers)} numbers are as {path} says{left}", data=data)


def _split(pair: str) -> tuple[str, str]:
    old, found, new = pair.partition(":=")
    if not found or not old.startswith("/") or not new.startswith("/"):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--remap {pair!r}: expected /from:=/to")
    return old, new


def _about(domain: int) -> dict[str, str]:
    from openarm_bringup.bags.about import about
    from openarm_bringup.supervision import runs

    try:
        return about(runs.the_running(domain))
    except OpenArmError:
        return about(None)  # recorded from a graph that was started by other means
