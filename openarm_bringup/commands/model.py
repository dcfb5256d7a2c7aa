# SPDX-License-Identifier: Apache-2.0
"""`openarm model`: the robot description in the form that another tool reads."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from openarm_bringup.outcome import Outcome


def model(
    kind: Literal["urdf", "mjcf", "srdf"],
    *,
    out: Path | None = None,
    render: Path | None = None,
    scene: str | None = None,
    seed: int = 0,
    view: str = "three_quarter",
) -> Outcome:
    """Write the robot as URDF, MJCF or SRDF, or a picture of it.

    Args:
        kind: urdf (expanded), mjcf (as MuJoCo reads it) or srdf.
        out: File to write; without one, the text is printed.
        render: PNG file for a picture of the robot in a scene.
        scene: mjcf and picture: name or path of a scene to put around the robot, or "random".
        seed: Seed of a random scene.
        view: Of the picture: front, three_quarter, side, back, top, or the name of a camera.
    """
    from openarm_sim_bridge.world.export import export, render_png

    text = export(kind, scene, seed) if scene is None or kind == "mjcf" else export(kind)
    written: list[str] = []
    if render is not None:
        render_png(render, scene or "demo", view=view, seed=seed)
        written.append(str(render))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
        written.append(str(out))
    data = {"kind": kind, "scene": scene, "written": written}
    if written:
        return Outcome(True, f"wrote {', '.join(written)}", data=data)
    return Outcome(True, data={**data, "text": text}, text=text)
