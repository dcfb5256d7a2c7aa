# SPDX-License-Identifier: Apache-2.0
"""Figures by matplotlib and HTML pages by jinja2; both libraries are imported when the first figure or page is made.

axes = sheet(0.210, 0.297, unit=METRE)            # A4, coordinates in metres
axes.add_patch(Circle((0.105, 0.1), 0.05))
Path("board.pdf").write_bytes(render_figure(axes, "pdf"))
"""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Inches in a unit of length.
POINT, METRE = 1.0 / 72.0, 1.0 / 0.0254
#: Text stays text that a reader can search; the same drawing gives the same file.
_STYLE: Any = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "openarm"}
_METADATA: dict[str, dict[str, Any]] = {
    "svg": dict.fromkeys(("Creator", "Date", "Format", "Type")),
    "pdf": {"CreationDate": None},
    "png": {},
}


def sheet(width: float, height: float, unit: float = POINT) -> Axes:
    """Make a page of an exact size, with the origin at its upper left and y down.

    Args:
        width: Width of the page, in units.
        height: Height of the page, in units.
        unit: Inches in a unit of the coordinates.
    """
    from matplotlib.figure import Figure

    axes = Figure(figsize=(width * unit, height * unit)).add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(height, 0.0))
    axes.set_axis_off()
    return axes


def render_figure(axes: Axes, form: Literal["png", "svg", "pdf"], *, dpi: float = 72.0, margin: float = -1.0) -> bytes:
    """Return the page of axes as a file.

    Args:
        axes: Axes of the page.
        form: Format of the file.
        dpi: Pixels an inch, of a PNG.
        margin: When not negative, the page is cut to this distance from what is drawn, in points.
    """
    from matplotlib import rc_context

    data, figure = io.BytesIO(), axes.get_figure(root=True)
    assert figure is not None
    tight: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": margin * POINT} if margin >= 0.0 else {}
    with rc_context(_STYLE):
        figure.savefig(data, format=form, dpi=dpi, metadata=_METADATA[form], **tight)
    return data.getvalue()


def data_uri(data: bytes, kind: str) -> str:
    """Return the address of an image that is part of a page.

    Args:
        data: The image file.
        kind: Its media type, such as `image/png`.
    """
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def render_page(template: Path, **values: Any) -> str:
    """Fill in a jinja2 template; values are escaped for HTML, and a name without a value is an error.

    Args:
        template: File of the template; it may include others of its folder.
        values: Values by the names that the template uses.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(template.parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template.name).render(values)
