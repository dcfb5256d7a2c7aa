# SPDX-License-Identifier: Apache-2.0
"""Folders of the suite's own objects: object.yaml, visual.obj with a small texture, collision.obj. m, kg."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.obj_file import obj_text
from openarm_common.objects.solid import hull_part
from openarm_common.resources import write_whole
from openarm_common.types import Array, Ints
from openarm_evaluation.objects.household import HOUSEHOLD, Household
from openarm_evaluation.objects.pieces import Piece

#: Edge of the field that a piece has in the texture, pixels; margin that is not used, share of it.
_FIELD, _MARGIN = 16, 0.2
_LICENCE = "Apache-2.0, made by `openarm objects make`"


def make_objects(
    folder: Path, names: Sequence[str] = (), advance: Callable[[str], None] = lambda name: None
) -> list[Path]:
    """Write object folders.

    Args:
        folder: Folder to write them into.
        names: Names in `HOUSEHOLD`; all without.
        advance: Called with each name that is done.

    Raises:
        OpenArmError: INVALID_ARGUMENT for a name that does not exist; ENVIRONMENT, when a file can't be written.
    """
    if unknown := [name for name in names if name not in HOUSEHOLD]:
        text = f"no object {', '.join(map(repr, unknown))}; objects: {', '.join(HOUSEHOLD)}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    made: list[Path] = []
    for name in names or HOUSEHOLD:
        _write(folder / name, name, HOUSEHOLD[name]())
        made.append(folder / name)
        advance(name)
    return made


def _write(folder: Path, name: str, made: Household) -> None:
    said = {"label": name.replace("_", " "), "mass": made.mass, "friction": made.friction}
    said |= {"color": list(made.pieces[0].color), "texture": "texture.png", "licence": _LICENCE}
    visual, picture = _visual(made.pieces)
    write_whole(folder / "object.yaml", yaml.safe_dump(said, sort_keys=False, default_flow_style=None).encode())
    write_whole(folder / "visual.obj", visual.encode())
    write_whole(folder / "texture.png", picture)
    write_whole(folder / "collision.obj", _collision(made.pieces).encode())


def _collision(pieces: Sequence[Piece]) -> str:
    points: list[Array] = []
    groups: list[tuple[str, Ints]] = []
    count = 0
    for corners in (part for piece in pieces for part in piece.parts):
        part = hull_part(np.round(corners, 5))
        if part is None:
            continue
        points.append(part.vertices)
        groups.append((f"part_{len(groups)}", part.triangles + count))
        count += len(part.vertices)
    return obj_text(np.concatenate(points), groups)


def _visual(pieces: Sequence[Piece]) -> tuple[str, bytes]:
    """Return the mesh of what is seen, and the picture of its texture: a column for each piece."""
    lines: list[str] = []
    faces: list[str] = []
    columns: list[Array] = []
    vertices = coordinates = 0
    for k, piece in enumerate(pieces):
        lines += [f"v {x:.5g} {y:.5g} {z:.5g}" for x, y, z in np.round(piece.vertices, 5).tolist()]
        columns.append(_column(piece))
        u = (k + 0.5) / len(pieces)
        if piece.bands:
            z = piece.vertices[:, 2]
            height = (z - z.min()) / max(float(np.ptp(z)), 1e-9)
            lines += [f"vt {u:.5g} {_MARGIN / 2.0 + v * (1.0 - _MARGIN):.3f}" for v in height.tolist()]
            shift = np.arange(len(piece.vertices))
        else:
            lines.append(f"vt {u:.5g} 0.5")
            shift = np.zeros(len(piece.vertices), np.int64)
        for corners in piece.triangles.tolist():
            told = (f"{vertices + c + 1}/{coordinates + int(shift[c]) + 1}" for c in corners)
            faces.append(f"f {' '.join(told)}")
        vertices += len(piece.vertices)
        coordinates += int(shift.max()) + 1
    buffer = io.BytesIO()
    picture = np.concatenate(columns, axis=1)
    Image.fromarray(np.clip(picture * 255.0, 0, 255).astype(np.uint8)).save(buffer, "PNG", optimize=True)
    return "\n".join([*lines, *faces]) + "\n", buffer.getvalue()


def _column(piece: Piece) -> Array:
    """Return the field (h, w, 3) of a piece in the texture, the top first."""
    height = 4 * _FIELD
    inside = np.clip((np.arange(height)[::-1] + 0.5) / height - _MARGIN / 2.0, 0.0, 0.999 - _MARGIN) / (1.0 - _MARGIN)
    bands = piece.bands or (piece.color,)
    index = np.minimum((inside * len(bands)).astype(np.int64), len(bands) - 1)
    return np.repeat(np.array(bands)[index][:, None], _FIELD, axis=1)
