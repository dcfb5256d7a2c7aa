# SPDX-License-Identifier: Apache-2.0
"""`openarm objects`: the suite's own shapes as folders, what objects there are, and pictures of them."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

#: Group of the command line.
objects = App(name="objects", help="Objects of any shape: make the suite's own, list and check them, draw them.")


@objects.command
def make(*, out: Path, only: tuple[str, ...] = ()) -> Outcome:
    """Write the suite's household shapes as object folders.

    Args:
        out: Folder that gets a folder for each.
        only: Names of those that are made, such as mug; may be given several times. All when not given.
    """
    from openarm_evaluation.objects.make import make_objects

    made = make_objects(out, only)
    return Outcome(True, f"{len(made)} objects in {out}", data={"folder": str(out), "objects": [p.name for p in made]})


@objects.command(name="list")
def list_(*sources: str) -> Outcome:
    """Read objects and say their size, mass, parts and sides; without names, all of models/objects.

    Args:
        sources: Names in models/objects, paths of folders, or superquadric:SEED.
    """
    from openarm_common.objects.model import load_object, object_names
    from openarm_common.objects.posed import posed_object

    rows: list[dict[str, object]] = []
    for source in sources or object_names():
        model = load_object(source)
        size = posed_object(source).size
        sides = [round(side.share, 3) for side in model.sides]
        rows.append({"object": source, "label": model.label, "mass_kg": round(model.mass, 4), "size_m": list(size)})
        rows[-1] |= {"parts": len(model.parts), "sides": sides}
    text = "\n".join(
        f"{row['object']!s:<16} {row['mass_kg']:>6} kg, {' x '.join(f'{1e3 * e:.0f}' for e in row['size_m'])} mm, "  # pyright: ignore
        f"{row['parts']} parts, {len(row['sides'])} sides"  # pyright: ignore
        for row in rows
    )
    return Outcome(True, f"{len(rows)} objects", data={"objects": rows}, text=text)


@objects.command
def draw(*sources: str, out: Path = Path("objects.png"), side: int = 0, parts: bool = False) -> Outcome:
    """Draw objects on a table, with their names; without names, all of models/objects.

    Args:
        sources: Names in models/objects, paths of folders, or superquadric:SEED.
        out: Picture, PNG.
        side: Side that each rests on, the most frequent is 0.
        parts: Draw the convex parts instead of what is seen.
    """
    from openarm_common.objects.model import object_names
    from openarm_evaluation.objects.sheet import write_sheet

    if side < 0 or out.suffix != ".png":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--side {side}, --out {out}: expected 0 or more, and NAME.png")
    write_sheet(out, sources or object_names(), side, parts=parts)
    return Outcome(True, f"Picture: {out}", data={"picture": str(out)})
