# SPDX-License-Identifier: Apache-2.0
"""Quality of service as rclpy has it and as a bag has it."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

#: What rosbag2 writes for "no limit".
_NEVER = QosTime(9223372036, 854775807)


def from_profile(profile: QoSProfile) -> Qos:
    """Return the profile as it is kept in a bag."""
    return Qos(
        history=QosHistory[profile.history.name],
        depth=profile.depth,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=_NEVER,
        lifespan=_NEVER,
        liveliness=QosLiveliness[LivelinessPolicy.AUTOMATIC.name],
        liveliness_lease_duration=_NEVER,
        avoid_ros_namespace_conventions=False,
    )


def to_profile(qos: Qos | None) -> QoSProfile:
    """Return a profile to publish with; reliable and volatile where a bag says nothing."""
    reliable = qos is None or qos.reliability != QosReliability.BEST_EFFORT
    latched = qos is not None and qos.durability == QosDurability.TRANSIENT_LOCAL
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(qos.depth, 10) if qos is not None else 10,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
