# SPDX-License-Identifier: Apache-2.0
"""A node with ROS 2's lifecycle, for nodes with a high load that can be deactivated."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from openarm_common.errors import OpenArmError
from openarm_common.ros.actions import RCLError
from openarm_common.ros.node import BaseNode, ConfigT


class ManagedNode(LifecycleNodeMixin, BaseNode[ConfigT]):
    """A node with the states of the lifecycle: unconfigured, inactive, active, finalized.

    A subclass makes what it needs in its constructor, at whose end it calls `autostart`; so a graph without a
    lifecycle manager has a node that works. Its services answer in every state.

    Args:
        name: Node name.
        model: Configuration model.
        kwargs: Passed to `BaseNode`.
    """

    def __init__(self, name: str, model: type[ConfigT], **kwargs: Any) -> None:
        BaseNode.__init__(self, name, model, **kwargs)
        LifecycleNodeMixin.__init__(self)
        # rclpy lets a transition that does not fit (by its number, as nav2 sends it) end the executor.
        answer: Callable[[Any, Any], Any] = self._service_change_state.callback

        def answer_or_refuse(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except RCLError as error:
                self.get_logger().warning(f"{error}")
                response.success = False
                return response

        self._service_change_state.callback = answer_or_refuse
        #: Whether the state is `active`.
        self.active = False

    def autostart(self) -> None:
        """Configure and activate."""
        self.trigger_configure()
        self.trigger_activate()

    @abstractmethod
    def begin(self) -> None:
        """Begin the work."""

    @abstractmethod
    def rest(self) -> None:
        """Stop the work: no subscription, no timer."""

    @abstractmethod
    def forget(self) -> None:
        """Discard the results of the work."""

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin."""
        return self._change(self.begin, True)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop."""
        return self._change(self.rest, False)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard."""
        return self._change(self.forget, False)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good."""
        return self._change(self.rest, False)

    def _change(self, work: Callable[[], None], active: bool) -> TransitionCallbackReturn:
        try:
            work()
        except OpenArmError as error:
            self.get_logger().error(f"the state stays as it was: {error}")
            return TransitionCallbackReturn.FAILURE
        self.active = active
        return TransitionCallbackReturn.SUCCESS
