# SPDX-License-Identifier: Apache-2.0
"""Objects of any shape in MuJoCo: one geom that is seen, and a convex geom for each part that is in contact."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import SceneObject
from openarm_sim_bridge.world.appearance import add_texture

#: Longer edges of a texture are reduced to this, pixels; longest file, bytes; most pixels before it is read.
_EDGE, _MAX_BYTES, _MAX_PIXELS = 1024, 32 * 2**20, 64 * 2**20
#: Rolling resistance needs the six dimensions of a contact; without it what is round rolls on for ever.
_CONDIM = 6


def add_mesh(spec: mujoco.MjSpec, body: Any, item: SceneObject, contact: Mapping[str, Any], condim: int) -> None:
    """Add the geoms of an object of any shape to its body.

    The geom that is seen has the object's name and touches nothing; the parts are not drawn.

    Args:
        spec: Model that is extended.
        body: Free body, whose frame is that of the upright box around the object.
        item: The object.
        contact: Geom attributes; friction is the object's own where it has one.
        condim: Contact dimensions; at least six.

    Raises:
        OpenArmError: CONFIG_INVALID, for a texture that can't be read.
    """
    posed = item.posed
    model = posed.model
    _add_visual(spec, body, item)
    volume = sum(part.volume for part in posed.parts)
    own = {"friction": model.friction} if model.friction is not None else {}
    for k, part in enumerate(posed.parts):
        name = f"{item.name}_part_{k}"
        mesh = spec.add_mesh(name=name, uservert=part.vertices.ravel(), userface=part.triangles.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            mass=item.mass_kg * part.volume / volume,
            rgba=item.rgba,
            condim=max(condim, _CONDIM),
            group=3,
            **{**contact, **own},
        )


def _add_visual(spec: mujoco.MjSpec, body: Any, item: SceneObject) -> None:
    """Add what is seen, with its texture where it has one."""
    posed = item.posed
    model, visual = posed.model, posed.model.visual
    textured = model.texture is not None and bool((visual.uv_triangles >= 0).all())
    mesh = spec.add_mesh(name=item.name, uservert=posed.visual.ravel(), userface=visual.triangles.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # an open one has no volume
    look: dict[str, Any] = {"rgba": item.rgba}
    if textured and model.texture is not None:
        mesh.usertexcoord = np.asarray(visual.uv, np.float64).ravel()
        mesh.userfacetexcoord = visual.uv_triangles.ravel()
        name = f"{item.name}_texture"
        add_texture(spec, name, texture_picture(model.texture))
        material = spec.add_material(name=name, specular=0.1, shininess=0.2)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        look = {"material": name}
    body.add_geom(
        name=item.name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=item.name,
        mass=0.0,
        contype=0,
        conaffinity=0,
        group=1,
        **look,
    )


def texture_picture(path: Path) -> NDArray[np.uint8]:
    """Return the picture of a texture (h, w, 3), red first, the bottom row first as texture coordinates have it.

    Raises:
        OpenArmError: CONFIG_INVALID, when it can't be read or is too large.
    """
    return _picture(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=64)
def _picture(path: Path, _stamp: int) -> NDArray[np.uint8]:
    from PIL import Image, UnidentifiedImageError

    try:
        if path.stat().st_size > _MAX_BYTES:
            raise OpenArmError(Code.CONFIG_INVALID, f"{path} is longer than {_MAX_BYTES // 2**20} MiB")
        with Image.open(path, formats=("PNG", "JPEG")) as opened:
            width, height = opened.size
            if width * height > _MAX_PIXELS:
                text = f"{path} has {width} x {height} pixels, expected at most {_MAX_PIXELS // 2**20} million"
                raise OpenArmError(Code.CONFIG_INVALID, text)
            picture = np.asarray(opened.convert("RGB"), np.uint8)
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} is no PNG or JPEG that can be read") from error
    scale = _EDGE / max(picture.shape[:2])
    if scale < 1.0:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture[::-1], np.uint8)
