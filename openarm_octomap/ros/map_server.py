# SPDX-License-Identifier: Apache-2.0
"""The services of the map: those of octomap_server, and those whose answers have a code and a message.

Boxes and points are in the base frame, m.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from octomap_msgs.srv import BoundingBoxQuery, GetOctomap
from openarm_interfaces.srv import ClearMap, MapFile, QueryMap
from std_srvs.srv import Empty

from openarm_common.asked_files import file_to_read, file_to_write
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import OTHERS
from openarm_common.octree.lattice import DEPTH
from openarm_common.ros.answers import answering
from openarm_common.ros.convert import ns_to_stamp, xyz
from openarm_common.ros.node import BaseNode
from openarm_octomap.config import UnknownPolicy
from openarm_octomap.kernels import FREE, UNKNOWN
from openarm_octomap.mapper import SUFFIXES, Mapper
from openarm_octomap.ros import convert

_STATES = {"free": FREE, "unknown": UNKNOWN}
_POLICIES: dict[str, UnknownPolicy] = {"occupied": "occupied", "free": "free"}


class MapServices:
    """Offers the services.

    Args:
        node: Its node.
        mapper: The map.
        depths: Further depths of the tree that are answered, below 16.
        stamp: Stamp of the newest image in the map, ns.
        show: Publishes a map that a request has changed.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        mapper: Mapper,
        depths: tuple[int, ...],
        stamp: Callable[[], int],
        show: Callable[[], None],
    ) -> None:
        self._log, self._frame = node.get_logger(), node.description.base
        self._mapper = mapper
        self._stamp = stamp
        self._show = show
        node.create_service(GetOctomap, "octomap_binary", self._answer_at(DEPTH))
        node.create_service(GetOctomap, "octomap_full", self._on_full)
        for depth in depths:
            node.create_service(GetOctomap, f"~/depth_{depth}/octomap_binary", self._answer_at(depth))
        node.create_service(BoundingBoxQuery, "~/clear_bbox", self._on_clear_bbox)
        node.create_service(Empty, "~/reset", self._on_reset)
        node.create_service(ClearMap, "~/clear", answering(self._clear))
        node.create_service(QueryMap, "~/query", answering(self._query))
        node.create_service(MapFile, "~/save", answering(self._save))
        node.create_service(MapFile, "~/load", answering(self._load))

    # --- octomap_server's
    def _on_full(self, _: GetOctomap.Request, response: GetOctomap.Response) -> GetOctomap.Response:
        snapshot = self._mapper.snapshot({"full"})
        if snapshot.full is not None:
            response.map = convert.octomap_msg(snapshot.full, snapshot.lattice.resolution, self._frame, self._stamp())
        return response

    def _answer_at(self, depth: int) -> Any:
        def respond(_: GetOctomap.Request, response: GetOctomap.Response) -> GetOctomap.Response:
            lattice, payload = self._mapper.coarse(depth)
            response.map = convert.octomap_msg(payload, lattice.resolution, self._frame, self._stamp())
            return response

        return respond

    def _on_clear_bbox(
        self, request: BoundingBoxQuery.Request, response: BoundingBoxQuery.Response
    ) -> BoundingBoxQuery.Response:
        try:
            self._mapper.clear_box(xyz(request.min), xyz(request.max), FREE)
            self._show()
        except OpenArmError as error:  # the service has no field for a reason
            self._log.error(str(error))
        return response

    def _on_reset(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        self._mapper.reset()
        self._show()
        return response

    # --- the suite's
    def _clear(self, request: ClearMap.Request, response: ClearMap.Response) -> str:
        state = _choose("state", request.state or "free", _STATES)
        response.cells = self._mapper.clear_box(xyz(request.min), xyz(request.max), state)
        self._show()
        return f"{response.cells} cells are {request.state or 'free'}"

    def _query(self, request: QueryMap.Request, response: QueryMap.Response) -> str:
        policy = _choose("unknown", request.unknown or "occupied", _POLICIES)
        points = np.array([(p.x, p.y, p.z) for p in request.points], np.float64).reshape(-1, 3)
        found = self._mapper.query(points, request.resolution, policy)
        response.resolution, response.stamp = found.resolution, ns_to_stamp(self._stamp())
        response.states, response.blocked = found.states.tolist(), found.blocked.tolist()
        return f"{int(found.blocked.sum())} of {len(points)} points are blocked at {found.resolution:g} m"

    def _save(self, request: MapFile.Request, response: MapFile.Response) -> str:
        path = file_to_write(request.path, SUFFIXES)
        response.nodes = self._mapper.save(path)
        return f"{path}: {response.nodes} nodes"

    def _load(self, request: MapFile.Request, response: MapFile.Response) -> str:
        path = file_to_read(request.path, SUFFIXES, OTHERS)
        taken = self._mapper.load(path)
        response.nodes, response.outside = taken.nodes, taken.outside
        self._show()
        return f"{path}: {taken.text}"


ChoiceT = TypeVar("ChoiceT")


def _choose(field: str, value: str, choices: dict[str, ChoiceT]) -> ChoiceT:
    if value not in choices:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{field} is {value!r}; valid: {', '.join(choices)}")
    return choices[value]
