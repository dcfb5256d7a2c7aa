# SPDX-License-Identifier: Apache-2.0
"""Simulated sensors: the wrench at a wrist, an IMU on the hand, and the contact force on a finger pad.

Forces are N, torques N m, accelerations m/s2, rates rad/s, in the frame of the body that carries the sensor.
"""

from __future__ import annotations

import mujoco
import numpy as np

from openarm_common.types import Array

_HAND_SENSORS = {
    "force": mujoco.mjtSensor.mjSENS_FORCE,
    "torque": mujoco.mjtSensor.mjSENS_TORQUE,
    "gyro": mujoco.mjtSensor.mjSENS_GYRO,
    "accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
}


def add_hand_sensors(spec: mujoco.MjSpec, body: str) -> None:
    """Add a force-torque sensor and an IMU to a body: sensors `{body}_force`, `_torque`, `_gyro`, `_accelerometer`."""
    site = f"{body}_sensors"
    spec.body(body).add_site(name=site, size=(0.004, 0.004, 0.004), group=4)
    for what, kind in _HAND_SENSORS.items():
        spec.add_sensor(name=f"{body}_{what}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)


def wrist_wrench(data: mujoco.MjData, body: str) -> tuple[Array, Array]:
    """Return force and torque (3,) by which the arm holds a body and all beyond it, in the body's frame.

    Args:
        data: The state after a step.
        body: Body with hand sensors.
    """
    return data.sensor(f"{body}_force").data.copy(), data.sensor(f"{body}_torque").data.copy()


def imu(data: mujoco.MjData, body: str) -> tuple[Array, Array]:
    """Return rate of turn and acceleration (3,) of a body in its frame; at rest, 9.81 m/s2 upwards as a real IMU.

    Args:
        data: The state after a step.
        body: Body with hand sensors.
    """
    return data.sensor(f"{body}_gyro").data.copy(), data.sensor(f"{body}_accelerometer").data.copy()


def contact_wrench(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Array, Array]:
    """Sum of the contact forces on a geom, and their torque about the origin of its body, (3,) in the body's frame.

    A contact names its two geoms in an order of MuJoCo's choice; its force is the one on the second.

    Args:
        model: The model.
        data: Its state after a step.
        geom: Its id.
    """
    force, torque, result = np.zeros(3), np.zeros(3), np.zeros(6)
    body = int(model.geom_bodyid[geom])
    origin, rotation = data.xpos[body], data.xmat[body].reshape(3, 3)
    for i in range(data.ncon):
        contact = data.contact[i]
        sign = float(contact.geom2 == geom) - float(contact.geom1 == geom)
        if sign == 0.0:
            continue
        mujoco.mj_contactForce(model, data, i, result)
        axes = contact.frame.reshape(3, 3)  # rows: normal from the first geom to the second, two tangents
        push, turn = sign * axes.T @ result[:3], sign * axes.T @ result[3:]
        force += push
        torque += turn + np.cross(contact.pos - origin, push)
    return rotation.T @ force, rotation.T @ torque
