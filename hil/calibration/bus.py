"""Finding the offsets of absolute encoders over the bus, of all joints at once, by SDO (Kim 2018 §8.1.4).

With the joints in a known posture, an encoder's offset is its reading less the joint's angle.
"""

from __future__ import annotations

import statistics
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import NamedTuple

import can
import canopen
from canopen.sdo.exceptions import SdoError

from hil.errors import EmulationError, UserError
from hil.standalone.joint import open_bus
from robots.description import Joint, Robot

_NAME, _POSITION, _STATUSWORD, _CALIBRATION = 0x1008, 0x6064, 0x6041, 0x2020
_OFFSET, _READING = 6, 7  # sub-indices of _CALIBRATION
_RADIAN = 1e-6  # of the position, per count
_PATIENCE_S = 5.0  # for an answer: the time of an emulation may run slowly
_QUIET_S = 0.5  # without a further node a scan is over
_SCAN_S = 5.0


class Measured(NamedTuple):
    """One joint in the known posture, rad."""

    joint: str
    node: int
    posture: float
    position: float  # that its drive reports
    reading: float  # mean of the absolute encoder's
    spread: float  # between the readings' extremes
    before: float  # offset that its drive has

    @property
    def offset(self) -> float:
        """What the encoder reads with the joint at 0."""
        return self.reading - self.posture

    @property
    def residual(self) -> float:
        """Error of the position that the drive reports."""
        return self.position - self.posture


class Drive:
    """A joint's drive on a bus, by its objects."""

    def __init__(self, joint: Joint, node: canopen.RemoteNode) -> None:
        self.joint = joint
        self._sdo = node.sdo
        self._sdo.RESPONSE_TIMEOUT = _PATIENCE_S

    def _upload(self, index: int, sub: int) -> bytes:
        try:
            return bytes(self._sdo.upload(index, sub))
        except SdoError as error:
            raise EmulationError(f"{self.joint.name}: no object {index:#06x}:{sub} ({error})") from None

    def name(self) -> str:
        """Robot and joint that the drive takes itself for."""
        return self._upload(_NAME, 0).decode("ascii", "replace")

    def position(self) -> float:
        """Of the joint, rad."""
        return struct.unpack("<i", self._upload(_POSITION, 0))[0] * _RADIAN

    def reading(self) -> float:
        """Of the absolute encoder, rad."""
        return struct.unpack("<f", self._upload(_CALIBRATION, _READING))[0]

    def offset(self) -> float:
        """That is in force, rad."""
        return struct.unpack("<f", self._upload(_CALIBRATION, _OFFSET))[0]

    def set_offset(self, offset: float) -> None:
        """Put ``offset`` [rad] in force. Raises UserError when the drive refuses."""
        try:
            self._sdo.download(_CALIBRATION, _OFFSET, struct.pack("<f", offset))
        except canopen.SdoAbortedError as error:
            raise UserError(f"{self.joint.name} refuses the offset {offset:g} rad: {error}; is it enabled?") from None
        except SdoError as error:
            raise EmulationError(f"{self.joint.name}: {error}") from None


@contextmanager
def drives(robot: Robot, buses: Sequence[str]) -> Iterator[list[Drive]]:
    """All drives of ``robot`` on the ``buses`` (``INTERFACE:CHANNEL``), in the order of its joints.

    Raises UserError for a bus that cannot be joined or has no drive, and for a drive of another robot.
    """
    networks: list[canopen.Network] = []
    found: dict[str, Drive] = {}
    joints = {joint.node_id: joint for joint in robot.joints}
    try:
        for where in buses:
            network = canopen.Network(open_bus(where))
            networks.append(network)
            network.connect()
            present = _scan(network, max(joints))
            mine = sorted(set(present) & set(joints))
            if not mine:
                raise UserError(f"--can {where}: no drive of {robot.name} answers there")
            for node_id in mine:
                joint = joints[node_id]
                drive = Drive(joint, network.add_node(canopen.RemoteNode(node_id, canopen.ObjectDictionary())))
                if drive.name() != f"{robot.name} {joint.name}":
                    raise UserError(
                        f"--can {where}: node {node_id} is {drive.name()!r}, not {f'{robot.name} {joint.name}'!r}"
                    )
                if joint.name in found:
                    raise UserError(f"--can {where}: {joint.name} is on another bus, too")
                found[joint.name] = drive
        yield [found[name] for name in robot.joint_names if name in found]
    except (can.CanError, OSError) as error:
        raise EmulationError(" ".join(str(error).split())) from None
    finally:
        for network in networks:
            with suppress(can.CanError, OSError):  # the bus may have gone before us
                network.disconnect()


def _scan(network: canopen.Network, limit: int) -> list[int]:
    """Node ids up to ``limit`` that answer, or are heard."""
    network.scanner.reset()
    network.scanner.search(limit)
    start = last = time.monotonic()
    known = 0
    while (now := time.monotonic()) - start < _SCAN_S and (not known or now - last < _QUIET_S):
        if len(network.scanner.nodes) > known:
            known, last = len(network.scanner.nodes), now
        time.sleep(0.01)
    return list(network.scanner.nodes)


def measure(found: Sequence[Drive], posture: Mapping[str, float], samples: int, rest: float) -> list[Measured]:
    """Read the encoders of the ``found`` drives that ``posture`` [rad] names, ``samples`` times in turn.

    Raises UserError when a joint's readings are not within ``rest`` rad: it moves.
    """
    chosen = [drive for drive in found if drive.joint.name in posture]
    readings: dict[str, list[float]] = {drive.joint.name: [] for drive in chosen}
    positions: dict[str, list[float]] = {drive.joint.name: [] for drive in chosen}
    for _ in range(samples):
        for drive in chosen:
            readings[drive.joint.name].append(drive.reading())
            positions[drive.joint.name].append(drive.position())
    measured = []
    for drive in chosen:
        name = drive.joint.name
        spread = max(readings[name]) - min(readings[name])
        if spread > rest:
            raise UserError(f"{name} moves: its encoder's readings are {1e3 * spread:.1f} mrad apart; hold it still")
        measured.append(
            Measured(
                name, drive.joint.node_id, posture[name], statistics.fmean(positions[name]),
                statistics.fmean(readings[name]), spread, drive.offset(),
            )
        )  # fmt: skip
    return measured
