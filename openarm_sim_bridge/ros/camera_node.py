# SPDX-License-Identifier: Apache-2.0
"""Node `mujoco_cameras`: draws the cameras in a process of its own and publishes their images.

Started by the bridge, which hands over the states to draw (see `handover`); it ends with the bridge. It has no
executor: one thread draws and publishes.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from openarm_common.errors import Code, OpenArmError
from openarm_sim_bridge.cameras.handover import CameraReport, RenderWork, StateReceiver
from openarm_sim_bridge.ros.camera_publisher import CameraPublisher

NODE_NAME = "mujoco_cameras"
#: Period in which subscribers are counted and the bridge gets a report, s.
_REPORT_S = 0.2
#: Of the process, below that of the bridge; one busy process leaves it a quarter of a processor.
_NICE = 5


class CameraNode(Node):
    """Draws the states that it receives.

    Args:
        receiver: Receiver of states.
    """

    def __init__(self, receiver: StateReceiver) -> None:
        super().__init__(NODE_NAME, start_parameter_services=False, enable_rosout=False)
        self._receiver = receiver
        self._names = [camera.name for camera in receiver.setup.cameras]
        self._images = CameraPublisher(self, receiver.setup)
        self._rendered = dict.fromkeys(self._names, 0)
        self._spent_s = 0.0
        self._drawn = 0
        self._ready = False
        self._fault = ""
        self._faults = receiver.faults
        self._report_at = 0.0

    def work(self) -> None:
        """Draw until the bridge ends.

        Raises:
            EOFError: The bridge has ended.
        """
        while True:
            work = self._receiver.take(min(_REPORT_S, self._images.publish_late()))
            if self._receiver.faults is not self._faults:
                self._faults = self._receiver.faults
                self._images.set_faults(self._faults)
            if work is not None and not self._fault:
                self._attempt(work)
            if time.monotonic() >= self._report_at:
                self._report()

    def _attempt(self, work: RenderWork) -> None:
        try:
            self._draw(work)
        except OpenArmError as error:
            self._fault = str(error)
        except Exception as error:  # what OpenGL raises is not known beforehand, and images must not end unnoticed
            self._fault = str(OpenArmError(Code.INTERNAL, f"drawing failed: {error!r}"))
        if self._fault:
            self._report()

    def _draw(self, work: RenderWork) -> None:
        images = self._images
        if not self._ready:  # the first frame of a camera takes long
            images.cameras.load(work.snapshot)
            for name in self._names:
                images.draw(name)
            self._ready = True
            gc.collect()
            gc.freeze()
            self._report()
        if not work.names:
            return
        began = time.monotonic()
        due = [name for name in self._names if name in work.names]
        wanted = [name for name in due if images.wants_image(name)]
        if wanted:
            images.cameras.load(work.snapshot)
        for name in due:
            if name in wanted:
                images.draw(name)
                self._rendered[name] += 1
            images.publish(name, work.snapshot.t_ns, drawn=name in wanted)
        self._spent_s += time.monotonic() - began
        self._drawn += len(wanted)

    def _report(self) -> None:
        self._report_at = time.monotonic() + _REPORT_S
        self._receiver.report(
            CameraReport(
                ready=self._ready,
                fault=self._fault,
                rates=self._images.poll(),
                rendered=dict(self._rendered),
                dropped=self._receiver.dropped,
                draw_ms=1e3 * self._spent_s / max(self._drawn, 1),
            )
        )
        self._spent_s, self._drawn = 0.0, 0


def serve(end: socket.socket) -> None:
    """Run the node until the bridge ends.

    Args:
        end: End of the socket to the bridge.
    """
    # Signals of the terminal are for the bridge; this process ends when the bridge lets go of the socket.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(_NICE)  # a late image is a late image; a late joint state is a fault
    node: CameraNode | None = None
    try:
        receiver = StateReceiver(end)
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = CameraNode(receiver)
        node.work()
    except EOFError:
        pass  # the normal end
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def main() -> None:
    """Run the node; the only argument is the descriptor of its end of the socket."""
    serve(socket.socket(fileno=int(sys.argv[1])))


if __name__ == "__main__":
    main()
