# SPDX-License-Identifier: Apache-2.0
"""Figures of a campaign: rates with Wilson intervals, attempts, causes, time in states; as JSON, CSV and HTML."""

from __future__ import annotations

import csv
import html
import statistics
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openarm_evaluation.judging.provenance import wilson_low

Row = Mapping[str, Any]

_COLUMNS = (
    "set", "seed", "kind", "scene_hash", "objects", "targets", "outcome", "as_expected", "code", "arm", "attempts",
    "place_error_mm", "sim_s", "wall_s", "message", "again",
)  # fmt: skip


def interval(successes: int, n: int) -> dict[str, Any]:
    """A rate with its 95 % Wilson interval, %."""
    low, high = wilson_low(successes, n), 1.0 - wilson_low(n - successes, n)
    rate = successes / n if n else 0.0
    return {"n": n, "count": successes, "rate": round(rate, 4), "low": round(low, 4), "high": round(high, 4)}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """What a campaign came to; times in simulated s.

    `possible` are scenes that must be placed; those that may also be refused by name stand in `kinds` alone. `success`
    counts scenes in which all that was asked for was placed, and `refused_right` impossible ones that were
    refused with an expected code; `first_attempt` counts scenes that needed one attempt an object.
    """
    possible = [row for row in rows if row["expected"] == ["placed"]]
    impossible = [row for row in rows if "placed" not in row["expected"]]
    placed = [row for row in possible if row["placed"]]
    grasps = [grasp for row in rows for grasp in row["grasps"]]
    done = [grasp for grasp in grasps if grasp["placed"]]
    errors = sorted(float(grasp["place_error_mm"]) for grasp in done)
    times = sorted(float(grasp["sim_s"]) for grasp in done)
    failed = [row for row in rows if not row["as_expected"]]
    low, high = (interval(len(placed), len(possible))[key] for key in ("low", "high"))
    return {
        "n": len(rows),
        "success": len(placed),
        "possible": len(possible),
        "success_rate": interval(len(placed), len(possible)),
        "first_attempt": sum(row["attempts"] == 1 for row in placed),
        "first_attempt_rate": interval(sum(row["attempts"] == 1 for row in placed), len(possible)),
        "refused_right": interval(sum(bool(row["as_expected"]) for row in impossible), len(impossible)),
        "false_success": sum(bool(row["false_success"]) for row in rows),
        "false_success_high": interval(sum(bool(row["false_success"]) for row in rows), len(rows))["high"],
        "wilson_low": low,
        "wilson_high": high,
        "objects": interval(len(done), len(grasps)),
        "attempts": dict(sorted(Counter(int(row["attempts"]) for row in placed).items())),
        "causes": dict(Counter(_cause(row) for row in failed).most_common()),
        "kinds": _kinds(rows),
        "arms": _arms(grasps),
        "place_error_mm": _spread(errors, 2),
        "cycle_s": _spread(times, 2),
        "state_s": _states(done),
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
            **interval(sum(bool(row["as_expected"]) for row in mine), len(mine)),
            "codes": dict(Counter(row["code"] for row in mine).most_common()),
        }
        for kind, mine in sorted(kinds.items())
    }


def _arms(grasps: Sequence[Row]) -> dict[str, Any]:
    return {
        arm: interval(sum(bool(g["placed"]) for g in grasps if g["arm"] == arm), sum(g["arm"] == arm for g in grasps))
        for arm in ("left", "right")
    }


def _states(grasps: Sequence[Row]) -> dict[str, float]:
    """Mean time a placed object spent in each state, s."""
    total: dict[str, float] = defaultdict(float)
    for grasp in grasps:
        for step in grasp["states"]:
            total[step["state"]] += float(step["seconds"])
    return {state: round(seconds / len(grasps), 2) for state, seconds in total.items()}


def _spread(ordered: Sequence[float], digits: int) -> dict[str, float] | None:
    if not ordered:
        return None
    p95 = ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))]
    return {
        "median": round(statistics.median(ordered), digits),
        "p95": round(p95, digits),
        "max": round(ordered[-1], digits),
    }


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line a scene."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        writer.writerows([row.get(key, "") for key in _COLUMNS] for row in rows)


def figures(data: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of a campaign as names and texts."""
    s = data["summary"]
    out = [
        ("scenes", f"{s['n']} of {data['asked']} asked for"),
        ("placed within the attempts", _rate(s["success_rate"])),
        ("placed at the first attempt", _rate(s["first_attempt_rate"])),
    ]
    if s["refused_right"]["n"]:
        out.append(("impossible ones refused with the right code", _rate(s["refused_right"])))
    out += [
        ("false successes", f"{s['false_success']} (95 %: below {100 * s['false_success_high']:.2f} %)"),
        ("objects placed", _rate(s["objects"])),
        ("attempts: scenes", ", ".join(f"{k}: {v}" for k, v in s["attempts"].items()) or "none"),
        ("causes of what failed", ", ".join(f"{k}: {v}" for k, v in s["causes"].items()) or "none"),
    ]
    for key, name, unit in (("place_error_mm", "place error", "mm"), ("cycle_s", "time an object", "simulated s")):
        if s[key]:
            v = s[key]
            out.append((name, f"median {v['median']:g}, p95 {v['p95']:g}, max {v['max']:g} {unit}"))
    rate = data["scenes_per_hour"]
    speed = f", {rate} scenes an hour with {data['workers']} worker(s)" if rate else ""
    machine = data["machine"]
    out.append(("wall time", f"{data['wall_s']:.0f} s{speed}; {machine['cores']} cores, {machine['cpu']}"))
    return out


def _rate(v: Mapping[str, Any]) -> str:
    if not v["n"]:
        return "none asked for"
    return f"{v['count']} of {v['n']} = {100 * v['rate']:.1f} % (95 %: {100 * v['low']:.1f} to {100 * v['high']:.1f} %)"


_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:#222}
h1,h2{font-weight:600}table{border-collapse:collapse;width:100%;margin:1rem 0}
td,th{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
tr.bad td{background:#fdecea}code{background:#f3f3f3;padding:0 .25rem}
code,p{overflow-wrap:anywhere}img{width:16rem;margin-right:.5rem}
.bar{background:#4c78a8;height:.8rem}.wide{width:50%}"""


def write_html(path: Path, data: Mapping[str, Any]) -> None:
    """Write one page that needs nothing beside it."""
    s = data["summary"]
    body = ["<h1>Grasp campaign</h1>", _table((), figures(data))]
    if s["attempts"]:
        body += ["<h2>Attempts</h2>", _bars({f"{k}": v for k, v in s["attempts"].items()}, "scenes")]
    if s["causes"]:
        body += ["<h2>What failed</h2>", _bars(s["causes"], "scenes")]
    if s["state_s"]:
        body += ["<h2>Time in each state</h2>", _bars(s["state_s"], "s")]
    kinds = [
        (kind, v["expected"], f"{v['count']} of {v['n']}", ", ".join(f"{c} {n}" for c, n in v["codes"].items()))
        for kind, v in s["kinds"].items()
    ]
    arms = [(arm, _rate(v)) for arm, v in s["arms"].items()]
    body += ["<h2>Arms</h2>", _table(("arm", "objects placed"), arms)] if arms else []
    body += ["<h2>Kinds</h2>", _table(("kind", "expected", "as expected", "codes"), kinds)]
    body += _failures(path.parent, data["rows"])
    body += ["<h2>Scenes</h2>", _rows(data["rows"])]
    settings = {**data["settings"], **data["versions"]}
    body += ["<h2>Made with</h2>", _table((), [(k, str(v)) for k, v in settings.items()])]
    page = f"<!doctype html><meta charset=utf-8><title>Grasp campaign</title><style>{_STYLE}</style>" + "\n".join(body)
    path.write_text(page, encoding="utf-8")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "<tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in head) + "</tr>" if head else ""
    lines = ("<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table>{top}{''.join(lines)}</table>"


def _bars(values: Mapping[str, float], unit: str) -> str:
    most = max(values.values())
    lines = (
        f"<tr><td>{html.escape(str(k))}</td><td>{v:g} {unit}</td>"
        f'<td class=wide><div class=bar style="width:{100 * v / most:.0f}%"></div></td></tr>'
        for k, v in values.items()
    )
    return f"<table>{''.join(lines)}</table>"


def _failures(folder: Path, rows: Sequence[Row]) -> list[str]:
    """What the cameras saw of scenes that did not go as expected."""
    out: list[str] = []
    for row in rows:
        kept = folder / "failures" / str(row["seed"])
        pictures = [] if row["as_expected"] else sorted(kept.glob("failed*_spectator.png"))
        pictures += [] if row["as_expected"] else kept.glob("end_spectator.png")
        if pictures:
            links = (f"failures/{row['seed']}/{picture.name}" for picture in pictures)
            images = "".join(f'<a href="{link}"><img src="{link}" alt="{Path(link).stem}"></a>' for link in links)
            out.append(f"<p>seed {row['seed']}: {html.escape(str(row['message']))}</p><p>{images}</p>")
    return ["<h2>Not as expected: at each failure, and at the end</h2>", *out] if out else []


def _rows(rows: Sequence[Row]) -> str:
    head = ("seed", "scene", "kind", "outcome", "code", "attempts", "mm", "s", "message", "again")
    lines = ["<tr>" + "".join(f"<th>{h}</th>" for h in head) + "</tr>"]
    for row in rows:
        error = "" if row["place_error_mm"] is None else f"{row['place_error_mm']:.1f}"
        seed = str(row["seed"]) if row["as_expected"] else f'<a href="failures/{row["seed"]}">{row["seed"]}</a>'
        message = "" if row["placed"] else html.escape(row["message"])
        again = f"<code>{html.escape(row['again'])}</code>"
        cells = (seed, row["scene_hash"], html.escape(row["kind"]), row["outcome"], row["code"], str(row["attempts"]))
        cells = (*cells, error, f"{row['sim_s']:.1f}", message, again)
        mark = "" if row["as_expected"] else " class=bad"
        lines.append(f"<tr{mark}>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return f"<table>{''.join(lines)}</table>"
