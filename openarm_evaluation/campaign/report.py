# SPDX-License-Identifier: Apache-2.0
"""Figures of a campaign: rates with Wilson intervals, attempts, causes, time in states; as JSON, CSV and HTML."""

from __future__ import annotations

import csv
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openarm_common.camera.cameras import spectator_camera
from openarm_common.figures import data_uri, render_figure, render_page
from openarm_evaluation.judging.statistics import interval, rate_of, spread

Row = Mapping[str, Any]

_COLUMNS: Sequence[str] = (
    "set", "seed", "detector", "kind", "scene_hash", "objects", "targets", "outcome", "as_expected", "code", "arm",
    "attempts", "place_error_mm", "sim_s", "wall_s", "message", "again",
)  # fmt: skip

#: Scenes whose lines of time are drawn, and colours of the states.
_LINES = 40
_COLORS = {
    "DETECT": "#4c78a8", "TRANSFORM": "#9ecae9", "PLAN": "#79706e", "MOVE_TO_PREGRASP": "#f58518",
    "MOVE_TO_GRASP": "#ffbf79", "CLOSE_GRIPPER": "#b279a2", "LIFT": "#54a24b", "PLACE": "#88d27a", "RESET": "#e45756",
}  # fmt: skip
#: How far a grasp has come, by the state that it has entered.
_STAGES = {
    "seen": "TRANSFORM",
    "grasps found": "PLAN",
    "planned": "MOVE_TO_PREGRASP",
    "held": "LIFT",
    "lifted": "PLACE",
}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Sum up a campaign; times in simulated s.

    `possible` are scenes that must be placed; those that may also be refused by name are in `kinds` only. `success`
    counts scenes in which all requested objects were placed, and `refused_right` impossible ones that were refused
    with an expected code; `first_attempt` counts scenes that needed one attempt an object.
    """
    possible = [row for row in rows if row["expected"] == ["placed"]]
    impossible = [row for row in rows if "placed" not in row["expected"]]
    placed = [row for row in possible if row["placed"]]
    grasps = [grasp for row in rows for grasp in row["grasps"]]
    done = [grasp for grasp in grasps if grasp["placed"]]
    arms = sorted({grasp["arm"] for grasp in grasps} - {""})
    failed = [row for row in rows if not row["as_expected"]]
    success, seconds = interval(len(placed), len(possible)), sum(float(row["sim_s"]) for row in rows)
    first = sum(row["attempts"] == 1 for row in placed)
    return {
        "n": len(rows),
        "success": len(placed),
        "possible": len(possible),
        "success_rate": success,
        "first_attempt": first,
        "first_attempt_rate": interval(first, len(possible)),
        "refused_right": rate_of(row["as_expected"] for row in impossible),
        "false_success": sum(bool(row["false_success"]) for row in rows),
        "false_success_high": rate_of(row["false_success"] for row in rows)["high"],
        "wilson_low": success["low"],
        "wilson_high": success["high"],
        "objects": interval(len(done), len(grasps)),
        **_things(rows),
        "attempts": dict(sorted(Counter(int(row["attempts"]) for row in placed).items())),
        "causes": dict(Counter(_cause(row) for row in failed).most_common()),
        "kinds": _kinds(rows),
        "arms": {arm: rate_of(g["placed"] for g in grasps if g["arm"] == arm) for arm in arms},
        "detectors": {
            kind: rate_of(row["placed"] for row in possible if row["detector"] == kind)
            for kind in sorted({row["detector"] for row in rows})
        },
        "place_error_mm": spread(grasp["place_error_mm"] for grasp in done),
        "cycle_s": spread(grasp["sim_s"] for grasp in done),
        "picks_per_hour": round(3600.0 * len(done) / seconds) if seconds > 0.0 else None,
        "waiting": _waiting(rows),
        "state_s": _states(done),
    }


def _things(rows: Sequence[Row]) -> dict[str, Any]:
    """Sum up objects of any shape; empty without any.

    `graspable` is the share that a hand can take at all, as the judge decides on the true meshes; `cleared` are those
    of them that were placed, `of_object` the same by object, `reached` how many of their grasps got how far; `refused`
    the codes of those that were not.
    """
    found = [(row, name, thing) for row in rows for name, thing in row.get("things", {}).items()]
    if not found:
        return {}
    placed = {(id(row), g["target"]) for row in rows for g in row["grasps"] if g["placed"]}
    can = [(row, name, thing) for row, name, thing in found if not thing["why_not"]]
    by_object: dict[str, list[bool]] = defaultdict(list)
    for row, name, thing in can:
        by_object[Path(thing["object"]).name].append((id(row), name) in placed)
    wanted = {(id(row), name) for row, name, _ in can}
    tried = [g for row in rows for g in row["grasps"] if (id(row), g["target"]) in wanted]
    open_ = [g["code"] for row in rows if "things" in row for g in row["grasps"] if not g["placed"]]
    return {
        "graspable": interval(len(can), len(found)),
        "cleared": rate_of((id(row), name) in placed for row, name, _ in can),
        "of_object": {name: rate_of(outcomes) for name, outcomes in sorted(by_object.items())},
        "reached": {
            **{
                what: sum(any(s["state"] == name for s in g.get("states", ())) for g in tried)
                for what, name in _STAGES.items()
            },
            "placed": sum(bool(g["placed"]) for g in tried),
            "claimed": sum(bool(g.get("claimed_success")) for g in tried),
        },
        "refused": dict(Counter(open_).most_common()),
    }


def _cause(row: Row) -> str:
    """Why a scene did not go as expected."""
    if row["code"] != "OK":
        return str(row["code"])
    return "false success" if row["false_success"] else "placed, though that should not be possible"


def _kinds(rows: Sequence[Row]) -> dict[str, Any]:
    kinds: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        kinds[row["kind"]].append(row)
    return {
        kind: {
            "expected": " or ".join(mine[0]["expected"]),
            **rate_of(row["as_expected"] for row in mine),
            "codes": dict(Counter(row["code"] for row in mine).most_common()),
        }
        for kind, mine in sorted(kinds.items())
    }


def _waiting(rows: Sequence[Row]) -> float | None:
    """Return the share of the time of scenes in which an arm has nothing to do; None where no two arms work at once."""
    busy, lasted = 0.0, 0.0
    for row in (row for row in rows if "arm_clearance_mm" in row):
        worked = [grasp for grasp in row["grasps"] if grasp["arm"]]
        busy += sum(grasp["sim_s"] for grasp in worked)
        lasted += len({grasp["arm"] for grasp in worked}) * float(row["sim_s"])
    return round(1.0 - busy / lasted, 3) if lasted else None


def _states(grasps: Sequence[Row]) -> dict[str, float]:
    """Mean time a placed object spent in each state, s."""
    total: dict[str, float] = defaultdict(float)
    for grasp in grasps:
        for step in grasp.get("states", ()):
            total[step["state"]] += float(step["seconds"])
    return {state: round(seconds / len(grasps), 2) for state, seconds in total.items()}


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line a scene."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def figures(data: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of a campaign as names and texts."""
    s = data["summary"]
    out = [
        ("scenes", f"{s['n']} of {data['asked']} requested"),
        ("placed within the attempts", _rate(s["success_rate"])),
        ("placed at the first attempt", _rate(s["first_attempt_rate"])),
    ]
    if s["refused_right"]["n"]:
        out.append(("impossible ones refused with the right code", _rate(s["refused_right"])))
    out += [
        ("false successes", f"{s['false_success']} (95 %: below {100 * s['false_success_high']:.2f} %)"),
        ("objects placed", _rate(s["objects"])),
        *_figures_of_things(s),
        *((f"objects placed by the {arm} arm", _rate(rate)) for arm, rate in s["arms"].items()),
        *((f"placed with detector {kind}", _rate(rate)) for kind, rate in s["detectors"].items()),
        ("attempts: scenes", ", ".join(f"{k}: {v}" for k, v in s["attempts"].items()) or "none"),
        ("causes of what failed", ", ".join(f"{k}: {v}" for k, v in s["causes"].items()) or "none"),
    ]
    for key, name, unit in (("place_error_mm", "place error", "mm"), ("cycle_s", "time an object", "simulated s")):
        if s[key]:
            v = s[key]
            out.append((name, f"median {v['median']:g}, p95 {v['p95']:g}, max {v['max']:g} {unit}"))
    out.append(("objects placed in an hour of robot time, failures included", str(s["picks_per_hour"] or "none")))
    if s["waiting"] is not None:
        out.append(("arms wait", f"{100 * s['waiting']:.0f} % of the time"))
    rate = data["scenes_per_hour"]
    speed = f", {rate} scenes an hour with {data['workers']} worker(s)" if rate else ""
    machine = data["machine"]
    out.append(("wall time", f"{data['wall_s']:.0f} s{speed}; {machine['cores']} cores, {machine['cpu']}"))
    return out


def _figures_of_things(s: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of objects of any shape; none without."""
    if "graspable" not in s:
        return []
    missed = [f"{name} {v['n'] - v['count']} of {v['n']}" for name, v in s["of_object"].items() if v["count"] < v["n"]]
    return [
        ("graspable, as judged on the true meshes", _rate(s["graspable"])),
        ("graspable ones placed", _rate(s["cleared"])),
        ("grasps of graspable ones that got so far", ", ".join(f"{k} {v}" for k, v in s["reached"].items())),
        ("graspable ones not placed", ", ".join(missed) or "none"),
        ("answers where nothing was placed", ", ".join(f"{k}: {v}" for k, v in s["refused"].items()) or "none"),
    ]


def _rate(v: Mapping[str, Any]) -> str:
    if not v["n"]:
        return "none requested"
    return f"{v['count']} of {v['n']} = {100 * v['rate']:.1f} % (95 %: {100 * v['low']:.1f} to {100 * v['high']:.1f} %)"


def write_html(path: Path, data: Mapping[str, Any]) -> None:
    """Write one page; only the pictures of failures are files next to it."""
    kept = [f"{row.get('folder', '')}failures/{row['seed']}" for row in data["rows"]]
    failures = [(row, _pictures(path.parent, folder)) for row, folder in zip(data["rows"], kept, strict=True)]
    page = render_page(
        Path(__file__).with_name("report.html"),
        data=data,
        summary=data["summary"],
        figures=figures(data),
        rate=_rate,
        lines=data_uri(time_lines(data["rows"][:_LINES]), "image/svg+xml"),
        failures=[(row, pictures) for row, pictures in failures if pictures and not row["as_expected"]],
    )
    path.write_text(page, encoding="utf-8")


def time_lines(rows: Sequence[Row]) -> bytes:
    """Return a picture (SVG) of what each arm did when, a line for each scene and arm; gaps are waiting.

    Args:
        rows: Rows of scenes.
    """
    from matplotlib.figure import Figure

    lines: dict[str, list[tuple[str, float, float]]] = defaultdict(list)
    for row in rows:
        first = min((grasp.get("began_s", 0.0) for grasp in row["grasps"]), default=0.0)
        for grasp in row["grasps"]:
            at = grasp.get("began_s", 0.0) - first
            for step in grasp.get("states", ()):
                lines[f"{row['seed']} {grasp['arm']}"].append((step["state"], at, float(step["seconds"])))
                at += float(step["seconds"])
    axes = Figure(figsize=(9.0, 1.2 + 0.25 * len(lines))).add_subplot()
    for state, color in _COLORS.items():
        for height, line in enumerate(lines.values()):
            spans = [(at, seconds) for name, at, seconds in line if name == state]
            axes.broken_barh(spans, (height - 0.4, 0.8), color=color, label="" if height else state)
    axes.set_yticks(range(len(lines)), lines)
    axes.invert_yaxis()
    axes.set_xlabel("robot time, s")
    axes.spines.top.set_visible(False)
    axes.spines.right.set_visible(False)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5, frameon=False, fontsize="small")
    return render_figure(axes, "svg", margin=4.0)


def _pictures(campaign: Path, folder: str) -> list[str]:
    """Return the spectator's pictures at each failure and at the end, relative to the campaign's folder."""
    names = ("failed*", "end")
    found = (path for name in names for path in sorted((campaign / folder).glob(f"{name}_{spectator_camera()}.png")))
    return [f"{folder}/{path.name}" for path in found]
