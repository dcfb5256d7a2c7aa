# SPDX-License-Identifier: Apache-2.0
"""Node `octomap`: the environment of the robot as an octree, from depth images, under octomap_server's names.

Publishes octomap_binary, octomap_full (latched), centres, markers, projected map, and the distance field in shared
memory (`openarm_common.octree.distance_field`). Everything is in the base frame.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from openarm_common.camera.cameras import depth_camera, load_cameras
from openarm_common.errors import OpenArmError
from openarm_common.octree.distance_field import CameraMoment, DistanceFieldWriter, field_path
from openarm_common.robot.held import HeldBox
from openarm_common.robot.posture import JointNeed
from openarm_common.ros.lifecycle_node import ManagedNode
from openarm_common.ros.node import run
from openarm_common.ros.tf import RobotStateListener
from openarm_octomap.config import OctomapNodeConfig
from openarm_octomap.mapper import Frame, Mapper, MapReport
from openarm_octomap.ros.map_publisher import MapPublisher
from openarm_octomap.ros.map_server import MapServices
from openarm_octomap.ros.map_topic import MapTopic
from openarm_octomap.ros.sources import MapSource, cloud_source, depth_source


class OctomapNode(ManagedNode[OctomapNodeConfig]):
    """Keeps the map, publishes it and answers queries; subscribes to the cameras while its state is active."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("octomap", OctomapNodeConfig, **kwargs)
        config = self.config
        self._mapper = Mapper(self.description, config.grid, config.filter, config.field)
        if config.map_file:
            taken = self._mapper.load(Path(config.map_file).expanduser())
            self.get_logger().info(f"map of {config.map_file}: {taken.text}")
        self._states = RobotStateListener(
            self, self.description, joints=False, depth=100, wait=config.transform_wait, held_topic=config.held_topic
        )
        self._mapper.mount(load_cameras())
        self._states.follow_mounts(self._mapper.mount)
        need: JointNeed = "required" if config.filter.enabled else "none"
        topics = {"depth": config.depth_topic, "info": config.info_topic}
        cameras = [depth_camera(name) for name in config.cameras]
        self._cameras = [depth_source(self, self._states, camera, topics, need) for camera in cameras]
        # Twice in a period: the newest is then at most half a period old.
        taken = [topic.format(camera=name) for topic in topics.values() for name in config.cameras]
        self.take_images_at(2.0 / config.period, taken)
        self._sources: list[MapSource] = [*self._cameras]
        if config.cloud_topic:
            self._sources.append(cloud_source(self, self._states, config.cloud_topic, need))
        self._t_ns = 0
        self._busy = False
        self._updates = self._overruns = 0
        self._elapsed_ms = 0.0
        self._last: MapReport | None = None
        self._fault = ""
        self._field = self._open_field() if config.field.enabled else None
        self._publisher = MapPublisher(self, self.description.base, full=config.publish_full)
        MapServices(self, self._mapper, config.coarse_depths, lambda: self._t_ns, self._show)
        self._maps = (
            MapTopic(self, self._mapper, self._states, config.map_topic, self._show) if config.map_topic else None
        )
        self._timer = self.create_timer(config.period, self._on_timer, clock=self.steady_clock)
        self._timer.cancel()
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        if config.map_file:
            self._show()
        if config.autostart:
            self.autostart()

    def close(self) -> None:
        """Wait for a running update, then take the distance field away."""
        super().close()
        if self._field is not None:
            self._field.close()

    # --- lifecycle
    def begin(self) -> None:
        """Listen to cameras and joints, and update."""
        self._states.enable(True)
        for source in self._sources:
            source.listen(True)
        self._timer.reset()

    def rest(self) -> None:
        """Leave the map as it is; its age is in what it publishes."""
        self._timer.cancel()
        for source in self._sources:
            source.listen(False)
        self._states.enable(False)

    def forget(self) -> None:
        """Everything becomes unknown."""
        self._mapper.reset()
        self._show()

    @property
    def idle(self) -> bool:
        """Whether no update runs and no frame waits for one."""
        return not self._busy and not any(source.waiting for source in self._sources)

    # --- updates
    async def _on_timer(self) -> None:
        if self._busy:
            self._overruns += 1
            return
        edition = self._mapper.edition
        found = [source.take() for source in self._sources]
        frames = [frame for frame in found if frame is not None]
        if not frames:
            return
        self._busy = True
        try:
            report: MapReport = await self.in_thread(
                self._update, frames, self._states.tracker.held, self._publisher.wanted(), edition
            )
        except OpenArmError as error:
            self._fault = error.message
            return
        finally:
            self._busy = False
        self._fault, self._last = "", report
        self._updates += 1
        self._t_ns = max(frame.t_ns for frame in frames)
        if edition == self._mapper.edition:
            self._publisher.publish(report.snapshot, self._t_ns, report.changed)
        else:  # the map was reset, loaded or edited meanwhile: what was computed is out of date
            self._show()

    def _update(self, frames: list[Frame], held: tuple[HeldBox, ...], wanted: set[str], edition: int) -> MapReport:
        """Do one update, in a worker thread."""
        begin = time.thread_time()
        slot = self._field.begin() if self._field is not None else None
        report = self._mapper.update(frames, held, slot, wanted, edition)
        by_name = {source.name: source for source in self._sources}
        for frame in () if report.outdated else frames:
            by_name[frame.source].took(frame.t_ns)
        if self._field is not None:
            self._field.commit(max(frame.t_ns for frame in frames), time.monotonic_ns(), self._moments())
        self._elapsed_ms = (time.thread_time() - begin) * 1e3
        return report

    def _show(self) -> None:
        """Make a map that did not come from an image visible everywhere, at once, and forget the images before it."""
        for source in self._sources:
            source.forget()
        self._publisher.publish(self._mapper.snapshot(self._publisher.wanted(everything=True)), self._t_ns)
        if self._field is not None and not self._busy:
            self._mapper.compute_distances(self._field.begin())
            self._field.commit(self._t_ns, time.monotonic_ns(), self._moments())

    def _moments(self) -> dict[str, CameraMoment]:
        return {camera.name: CameraMoment(camera.used_t_ns, camera.used_at_ns) for camera in self._cameras}

    # --- health
    def _report(self) -> None:
        if not self.active:
            self.diagnose(True, "inactive: /octomap/change_state activates it", updates=self._updates)
            return
        limit = self.config.stale_after
        faults = [self._fault] if self._fault else []
        values: dict[str, object] = {"updates": self._updates, "overruns": self._overruns}
        if self._maps is not None:
            faults += [self._maps.fault] if self._maps.fault else []
            values["map_topic"] = self._maps.text or "no map yet"
        for source in self._sources:
            camera = source in self._cameras
            age = source.age_s()
            if camera and age > limit:
                since = "never used" if age == float("inf") else f"not used for {age:.1f} s"
                fault = source.fault or source.missing()
                faults.append(f"{source.name} {since}" + (f" ({fault})" if fault else ""))
            elif source.fault:
                faults.append(source.fault)
            values |= {f"{source.name}_used": source.used, f"{source.name}_refused": source.refused}
            values |= {f"{source.name}_late": source.late, f"{source.name}_age_s": f"{age:.2f}"}
            values[f"{source.name}_incomplete"] = source.incomplete
        if self._last is not None:
            values |= {"changed": self._last.changed.size, "robot_cells": self._last.reset, "ends": self._last.ends}
            values |= self._mapper.counts(self._t_ns)
            for source_name, links in self._last.removed.items():
                values |= {f"{source_name}_removed/{link}": n for link, n in links.items()}
            values |= {f"{source_name}_flying": n for source_name, n in self._last.flying.items()}
        values |= {
            "update_ms": f"{self._elapsed_ms:.1f}",
            "held": ", ".join(b.name for b in self._states.tracker.held) or "nothing",
        }
        self.diagnose(not faults, "; ".join(faults) or f"map of {', '.join(self.config.cameras)}", **values)

    def _open_field(self) -> DistanceFieldWriter:
        domain = str(self.context.get_domain_id())
        path = field_path(self.config.field.name or domain)
        names = [camera.name for camera in self._cameras]
        return DistanceFieldWriter(path, self._mapper.lattice, self.config.field.reach, self.description.base, names)


def main() -> None:
    """Run the node."""
    run(OctomapNode)


if __name__ == "__main__":
    main()
