"""OpenIGTLink as a source of events: poses of devices, as servers of trackers (PLUS, 3D Slicer, MITK) send them.

A message is a header of 58 bytes and a body, in big endian; lengths are in mm (`protocol
<https://github.com/openigtlink/OpenIGTLink/tree/master/Documents/Protocol>`_). A device is the sensor of its name; the
device ``command`` tells where the arm is sent.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from ..fusion.config import FusionConfig
from ..logs.frames import CARTESIAN
from ..units import MM
from .address import Address
from .network import EventClient, Refused
from .tool import ORIENTATION, takes_orientation
from .wire import Event

_HEAD = struct.Struct(">H12s20sIIQQ")  # version, type, device, seconds and their fraction, bytes of the body, checksum
_EXTENDED = struct.Struct(">HHI")  # from version 2 on: bytes of this header, of the metadata's index, and of its texts
_KEY = struct.Struct(">HHI")  # of a metadatum: bytes of its key, encoding, bytes of its value
_POINT, _QUATERNION, _MATRIX = struct.Struct(">3f"), struct.Struct(">7f"), struct.Struct(">12f")
_POSES = {"TRANSFORM": (_MATRIX,), "POSITION": (_POINT, _QUATERNION), "QTRANS": (_QUATERNION,)}  # of one device
_LISTS = {"TDATA": _MATRIX, "QTDATA": _QUATERNION}  # of several: name, kind, an unused byte, pose
_NAME = struct.Struct(">20sBx")
_LARGEST = 1 << 16  # bytes of a message of poses
_COMMAND = "command"  # the device
_STATUS, _SEEN = "TransformStatus", "OK"  # a metadatum: whether the tracker sees the device

_Poses: TypeAlias = list[tuple[str, list[float]]]  # each device of a message, and the numbers of its pose


class OpenIgtLinkSource(EventClient):
    """Events of a server of poses: x, y, z as far as these are axes, and an orientation of a tool that turns."""

    REFUSED = "no OpenIGTLink: "

    def __init__(self, address: Address, config: FusionConfig, notify: Callable[[str], None]) -> None:
        super().__init__(address, notify)
        in_space = config.frame is not None or any(sensor.is_placed for sensor in config.sensors.values())
        self._axes = [in_space or axis in config.arm.axes for axis in CARTESIAN]
        self._turns, self._on_receipt = takes_orientation(config), address.on_receipt

    def _receive(self, connection: socket.socket) -> Iterator[list[Event]]:
        for stamp, seen, poses in _messages(connection.makefile("rb")):
            stamp = time.time_ns() if self._on_receipt or not stamp else stamp
            tracked = ((device, pose if seen else [math.nan] * len(pose)) for device, pose in poses)
            yield [Event(stamp, "" if device == _COMMAND else device, self._values(pose)) for device, pose in tracked]

    def _values(self, pose: list[float]) -> dict[str, Any]:
        """The values of a pose: a point and perhaps a quaternion, or the columns of a rotation matrix and a point."""
        point = pose[-3:] if len(pose) == 12 else pose[:3]
        values: dict[str, Any] = {
            axis: value / MM for axis, value, used in zip(CARTESIAN, point, self._axes, strict=True) if used
        }
        turned = _quaternion(pose) if self._turns and len(pose) > 3 and all(map(math.isfinite, pose)) else None
        if turned is not None:
            values[ORIENTATION] = turned
        return values


def _quaternion(pose: list[float]) -> tuple[float, ...] | None:
    """The quaternion x, y, z, w of a pose, of a matrix that of the rotation nearest to it; None where it has none."""
    if len(pose) == 7:
        return tuple(pose[3:])
    try:
        return tuple(Rotation.from_matrix(np.reshape(pose[:9], (3, 3)).T).as_quat().tolist())
    except ValueError:  # a mirror, or no turn at all
        return None


def _messages(stream: BinaryIO) -> Iterator[tuple[int, bool, _Poses]]:
    """Messages of poses, until the connection ends: stamp [ns], whether all is seen, poses. Others are passed over.

    Such are images.
    """
    with stream:
        while len(head := stream.read(_HEAD.size)) == _HEAD.size:
            version, kind, device, seconds, fraction, size, _ = _HEAD.unpack(head)
            if version not in (1, 2, 3):
                raise Refused(f"a header of version {version}")
            name = _text(kind)
            if name not in _POSES and name not in _LISTS:
                _pass_over(stream, size)
                continue
            if size > _LARGEST:
                raise Refused(f"a {name} of {size} bytes")
            body = stream.read(size)
            if len(body) < size:
                return
            stamp = seconds * 10**9 + (fraction * 10**9 >> 32)
            content, seen = (body, True) if version == 1 else _drop_metadata(body)
            yield stamp, seen, _poses(name, _text(device), content)


def _pass_over(stream: BinaryIO, size: int) -> None:
    """Read so many bytes, as there are, without keeping them."""
    while size > 0 and (piece := stream.read(min(size, _LARGEST))):
        size -= len(piece)


def _drop_metadata(body: bytes) -> tuple[bytes, bool]:
    """The content of a body of version 2 or later, and whether its metadata say that the device is seen."""
    before, index, texts = _EXTENDED.unpack_from(body)
    end = len(body) - index - texts
    seen, at = True, end + index
    for number in range(max(index - 2, 0) // _KEY.size):
        of_key, _, of_value = _KEY.unpack_from(body, end + 2 + number * _KEY.size)
        key, value = body[at : at + of_key], body[at + of_key : at + of_key + of_value]
        at += of_key + of_value
        seen = seen and (_text(key) != _STATUS or _text(value) == _SEEN)
    return body[before:end], seen


def _poses(kind: str, device: str, content: bytes) -> _Poses:
    """The poses of a message of one kind, by its device if it is of one."""
    if (layout := _LISTS.get(kind)) is not None:
        begins = range(0, len(content), _NAME.size + layout.size)
        poses = (list(layout.unpack_from(content, at + _NAME.size)) for at in begins)
        return [(_text(_NAME.unpack_from(content, at)[0]), pose) for at, pose in zip(begins, poses, strict=True)]
    layouts = _POSES[kind]
    fits = next((layout for layout in layouts if layout.size == len(content)), layouts[-1])
    return [(device, list(fits.unpack(content)))]


def _text(field: bytes) -> str:
    """A text of a field that is filled with zeros."""
    return field.partition(b"\0")[0].decode("utf-8", "replace").strip()
