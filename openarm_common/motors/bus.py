# SPDX-License-Identifier: Apache-2.0
"""Buses: whatever carries CAN frames, with one system call for all frames of a cycle each way.

A SocketCAN interface and a local socket carry the same bytes, `struct can_frame` or `struct canfd_frame` of Linux; only
opening differs. python-can (extra `can`) reaches adapters that the kernel has no driver for.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from openarm_common.errors import Code, OpenArmError, said

#: Id and data of a frame.
Frame = tuple[int, bytes]

_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_CLASSIC, _FLEXIBLE = struct.Struct("=IB3x8s"), struct.Struct("=IBBxx64s")
#: Bit rate switch: the data of the frame are sent at the faster rate.
_RATE_SWITCH = 0x01
#: Most frames of one system call.
_BATCH = 32
#: What a full queue says; the frames are lost, and the motors' missing replies show it.
_FULL = frozenset({errno.EAGAIN, errno.ENOBUFS})
#: Options of SocketCAN that Python's module has no names for everywhere.
_SOL_CAN_RAW, _RAW_ERR_FILTER, _RAW_FD_FRAMES = 101, 2, 5
_ERROR_MASK = 0x1FFFFFFF


def pack(frame: Frame, *, flexible: bool) -> bytes:
    """Return the bytes of a frame.

    Args:
        frame: Id of 11 bits, at most 8 bytes of data.
        flexible: Frame of CAN FD with the faster data rate.
    """
    number, data = frame
    return _FLEXIBLE.pack(number, len(data), _RATE_SWITCH, data) if flexible else _CLASSIC.pack(number, len(data), data)


def unpack(raw: bytes | memoryview) -> Frame | None:
    """Return the frame of some bytes; None for what is no data frame with an id of 11 bits."""
    if len(raw) == _CLASSIC.size:
        number, length, data = _CLASSIC.unpack(raw)
    elif len(raw) == _FLEXIBLE.size:
        number, length, _, data = _FLEXIBLE.unpack(raw)
    else:
        return None
    if number > 0x7FF or length > len(data):
        return None
    return number, data[:length]


def is_error(raw: bytes | memoryview) -> bool:
    """Return whether bytes are an error frame, by which a controller tells of bus errors."""
    known = len(raw) in (_CLASSIC.size, _FLEXIBLE.size)
    return known and bool(struct.unpack_from("=I", raw)[0] & _ERROR)


class Bus(ABC):
    """Carries frames.

    Attributes:
        address: Address that it was opened by.
        ignored: Frames that were received and are none of a motor's.
        errors: Error frames that were received.
        unsent: Frames that a full queue took not.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self.ignored = self.errors = self.unsent = 0

    @abstractmethod
    def receive(self) -> list[Frame]:
        """Return all frames that have come; does not wait.

        Raises:
            OSError: When the bus is gone.
        """

    @abstractmethod
    def send(self, frames: Sequence[Frame]) -> int:
        """Send frames without waiting; return how many were taken.

        Raises:
            OSError: When the bus is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Close it."""


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vector", ctypes.c_void_p),
        ("vectors", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Entry(ctypes.Structure):
    _fields_ = (("message", _Message), ("length", ctypes.c_uint))


class _Batch:
    """Room for some frames, as sendmmsg and recvmmsg want it."""

    def __init__(self, n: int, size: int) -> None:
        self._buffer = (ctypes.c_ubyte * (n * size))()
        self._vectors, self.entries = (_Vector * n)(), (_Entry * n)()
        base = ctypes.addressof(self._buffer)
        for i in range(n):
            self._vectors[i].base, self._vectors[i].length = base + i * size, size
            self.entries[i].message.vector = ctypes.addressof(self._vectors[i])
            self.entries[i].message.vectors = 1
        self.address = ctypes.addressof(self.entries)
        self.slots = [memoryview(self._buffer).cast("B")[i * size : (i + 1) * size] for i in range(n)]


class SocketBus(Bus):
    """A socket that keeps the borders of messages: CAN_RAW of SocketCAN, or a local one.

    Args:
        connection: Connected or bound.
        address: Names it.
        flexible: Whether frames are sent as CAN FD, and both kinds received; else classic ones alone, as by the kernel.
    """

    def __init__(self, connection: socket.socket, address: str, *, flexible: bool = True) -> None:
        super().__init__(address)
        connection.setblocking(False)
        self._socket, self._flexible = connection, flexible
        self._library = ctypes.CDLL(None, use_errno=True)
        self._in = _Batch(_BATCH, _FLEXIBLE.size + 1)  # a longer message is seen to be longer
        self._out = _Batch(_BATCH, _FLEXIBLE.size if flexible else _CLASSIC.size)

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[Frame]:
        """See `Bus.receive`."""
        found, batch = list[Frame](), self._in
        while True:
            n = self._library.recvmmsg(self._socket.fileno(), ctypes.c_void_p(batch.address), _BATCH, 0x40, None)
            if n < 0:
                self._check(ctypes.get_errno())
                return found
            if n == _BATCH and batch.entries[n - 1].length == 0:  # the end is an endless row of empty messages
                raise ConnectionResetError(errno.ECONNRESET, f"{self.address} was closed")
            for k in range(n):
                raw = batch.slots[k][: batch.entries[k].length]
                frame = unpack(raw) if self._flexible or len(raw) == _CLASSIC.size else None
                if frame is not None:
                    found.append(frame)
                elif is_error(raw):
                    self.errors += 1
                else:
                    self.ignored += 1
            if n < _BATCH:
                return found

    def send(self, frames: Sequence[Frame]) -> int:
        """See `Bus.send`."""
        sent = 0
        while sent < len(frames):
            part = frames[sent : sent + _BATCH]
            for slot, frame in zip(self._out.slots, part, strict=False):
                slot[:] = pack(frame, flexible=self._flexible)
            n = self._library.sendmmsg(self._socket.fileno(), ctypes.c_void_p(self._out.address), len(part), 0x4040)
            if n < 0:
                self._check(ctypes.get_errno())
                break
            sent += n
            if n < len(part):
                break
        self.unsent += len(frames) - sent
        return sent

    def close(self) -> None:
        """See `Bus.close`."""
        self._socket.close()

    def _check(self, number: int) -> None:
        if number not in _FULL and number != errno.EINTR:
            raise OSError(number, f"{self.address}: {os.strerror(number)}")


class PythonCanBus(Bus):
    """An adapter behind python-can, such as `python-can:pcan:PCAN_USBBUS1`.

    Args:
        bus: `can.BusABC`.
        message: `can.Message`.
        error: `can.CanError`.
        address: Names it.
        flexible: Whether frames are sent as CAN FD.
    """

    def __init__(
        self, bus: Any, message: Callable[..., Any], error: type[Exception], address: str, *, flexible: bool
    ) -> None:
        super().__init__(address)
        self._bus, self._message, self._error, self._flexible = bus, message, error, flexible

    def receive(self) -> list[Frame]:
        """See `Bus.receive`."""
        found = list[Frame]()
        while (message := self._call(lambda: self._bus.recv(timeout=0.0))) is not None:
            if message.is_error_frame:
                self.errors += 1
            elif message.is_extended_id or message.is_remote_frame or message.arbitration_id > 0x7FF:
                self.ignored += 1
            else:
                found.append((message.arbitration_id, bytes(message.data)))
        return found

    def send(self, frames: Sequence[Frame]) -> int:
        """See `Bus.send`."""
        kind = {"is_extended_id": False, "is_fd": self._flexible, "bitrate_switch": self._flexible}
        for sent, (number, data) in enumerate(frames):
            message = self._message(arbitration_id=number, data=data, **kind)
            try:
                self._bus.send(message, timeout=0.0)
            except self._error:  # python-can says no more precisely that the queue is full
                self.unsent += len(frames) - sent
                return sent
        return len(frames)

    def close(self) -> None:
        """See `Bus.close`."""
        self._bus.shutdown()

    def _call(self, what: Callable[[], Any]) -> Any:
        try:
            return what()
        except self._error as error:
            raise OSError(errno.EIO, f"{self.address}: {said(error)}") from error


def unix_name(path: str) -> str:
    """Return the name of a local socket; one that begins with @ is no file and ends with its process."""
    return f"\0{path[1:]}" if path.startswith("@") else path


def emulated_buses(domain: int, arms: Sequence[str], folder: str = "") -> dict[str, str]:
    """Return the addresses of the buses of emulated motors, by arm.

    Args:
        domain: ROS domain, by which those of several graphs differ.
        arms: Names.
        folder: Folder of their sockets; empty: they are no files.
    """
    return {arm: f"unix:{folder}/{arm}" if folder else f"unix:@openarm_motors_{domain}_{arm}" for arm in arms}


def open_bus(address: str, *, flexible: bool = True) -> Bus:
    """Open a bus.

    Args:
        address: `socketcan:INTERFACE`, `unix:PATH` or `unix:@NAME` (of an emulator) or `python-can:INTERFACE:CHANNEL`.
        flexible: Whether frames are sent as CAN FD.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the kinds; ENVIRONMENT, with what to do.
    """
    kind, _, rest = address.partition(":")
    try:
        if kind == "socketcan" and rest:
            return SocketBus(_can_socket(rest, flexible=flexible), address, flexible=flexible)
        if kind == "unix" and rest:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            connection.connect(unix_name(rest))
            return SocketBus(connection, address, flexible=flexible)
    except OSError as error:
        todo = f"`ip link show {rest}` says whether it is up" if kind == "socketcan" else "is the emulator running?"
        text = f"can't open {address}: {said(error)}; {todo}"
        raise OpenArmError(Code.ENVIRONMENT, text) from error
    if kind == "python-can" and rest.count(":") == 1:
        return _python_can(address, *rest.split(":"), flexible=flexible)
    expected = "socketcan:INTERFACE, unix:PATH or python-can:INTERFACE:CHANNEL"
    raise OpenArmError(Code.INVALID_ARGUMENT, f"bus {address[:80]!r} is not known; expected {expected}")


def _can_socket(interface: str, *, flexible: bool) -> socket.socket:
    family, protocol = getattr(socket, "AF_CAN", None), getattr(socket, "CAN_RAW", None)
    if family is None or protocol is None:
        raise OSError(errno.EAFNOSUPPORT, "this Python has no SocketCAN")
    connection = socket.socket(family, socket.SOCK_RAW, protocol)
    try:
        if flexible:
            connection.setsockopt(_SOL_CAN_RAW, _RAW_FD_FRAMES, 1)
        connection.setsockopt(_SOL_CAN_RAW, _RAW_ERR_FILTER, struct.pack("=I", _ERROR_MASK))
        connection.bind((interface,))
    except OSError:
        connection.close()
        raise
    return connection


def _python_can(address: str, interface: str, channel: str, *, flexible: bool) -> Bus:
    try:
        import can  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        text = f"{address} needs python-can; install it with `pip install python-can`"
        raise OpenArmError(Code.ENVIRONMENT, text) from error
    library: Any = can
    try:
        bus = library.Bus(interface=interface, channel=channel, fd=flexible)
    except Exception as error:  # each of its interfaces has errors of its own
        raise OpenArmError(Code.ENVIRONMENT, f"can't open {address}: {said(error)}") from error
    return PythonCanBus(bus, library.Message, library.CanError, address, flexible=flexible)
