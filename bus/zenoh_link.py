"""Key expressions, payloads and session settings of the Zenoh link between gateway and central controller.

docs/zenoh.md is the reference for other programs.

A bundle carries all that arrived since the last tick, or the commands and telemetry of an answer;
little-endian::

    u16 magic 0x4C48  u8 version  u8 0  u32 sequence  i64 time (ns)  u16 items  u16 values
    items:  i64 arrival (ns)  u32 CAN identifier  u8 source (bus; 255: IMU; 254: motion capture)  u8 length  data
    values: f64 each
"""

from __future__ import annotations

import json
import struct
from typing import Any, NamedTuple

import numpy as np

MAGIC = 0x4C48
VERSION = 2
IMU_SOURCE = 255
MOTION_CAPTURE_SOURCE = 254
_HEADER = struct.Struct("<HBBIqHH")
_ITEM = struct.Struct("<qIBB")

Item = tuple[int, int, int, bytes]  # arrival in ns, source, CAN identifier, data


class MalformedBundleError(ValueError):
    """A payload that is not a bundle of this version."""


class WrongVersionError(MalformedBundleError):
    """A bundle of another version of this layout."""


class Refused:
    """How many samples of a subscription were ignored, by reason."""

    def __init__(self) -> None:
        self.malformed = 0
        self.wrong_version = 0
        self.unexpected = 0  # a bundle, but not the one that was due

    def count(self, error: MalformedBundleError) -> None:
        if isinstance(error, WrongVersionError):
            self.wrong_version += 1
        else:
            self.malformed += 1

    def report(self) -> dict[str, int]:
        return dict(vars(self))


class Keys(NamedTuple):
    """Key expressions of one run."""

    state: str  # gateway to controller
    command: str  # controller to gateway
    inject: str  # query: change an impairment
    telemetry: str  # live signals
    status: str  # query: what a stand-alone bus has done


def keys(run: str) -> Keys:
    """Key expressions of the run ``run``."""
    return Keys(*(f"hil/{run}/{name}" for name in Keys._fields))


class Bundle(NamedTuple):
    sequence: int
    time_ns: int
    items: list[Item]
    values: np.ndarray


def encode_bundle(sequence: int, time_ns: int, items: list[Item], values: np.ndarray | None = None) -> bytes:
    """Payload of ``items`` and ``values`` (float64)."""
    count = 0 if values is None else len(values)
    parts = [_HEADER.pack(MAGIC, VERSION, 0, sequence, time_ns, len(items), count)]
    pack = _ITEM.pack
    for arrival, source, can_id, data in items:
        parts.append(pack(arrival, can_id, source, len(data)))
        parts.append(data)
    if values is not None:
        parts.append(values.tobytes())
    return b"".join(parts)


def bundle_sequence(payload: bytes) -> int:
    """Sequence number of a bundle, from its header alone. Raises MalformedBundleError."""
    if len(payload) < _HEADER.size:
        raise MalformedBundleError(f"{len(payload)} bytes are less than a bundle's header of {_HEADER.size}")
    magic, version, _, sequence, _, _, _ = _HEADER.unpack_from(payload)
    if magic != MAGIC:
        raise MalformedBundleError(f"magic {magic:#06x}, not {MAGIC:#06x}")
    if version != VERSION:
        raise WrongVersionError(f"a bundle of version {version}, not {VERSION}")
    return sequence


def decode_bundle(payload: bytes) -> Bundle:
    """Read a bundle. Raises MalformedBundleError when anything about it is not as it should be."""
    sequence = bundle_sequence(payload)
    _, _, reserved, _, time_ns, count, doubles = _HEADER.unpack_from(payload)
    if reserved:
        raise MalformedBundleError("reserved byte of the header is not 0")
    at, end = _HEADER.size, len(payload)
    unpack, size = _ITEM.unpack_from, _ITEM.size
    items: list[Item] = []
    for _ in range(count):
        if at + size > end:
            raise MalformedBundleError("the payload ends within an item")
        arrival, can_id, source, length = unpack(payload, at)
        at += size + length
        if at > end:
            raise MalformedBundleError(f"an item of {length} bytes does not fit")
        items.append((arrival, source, can_id, payload[at - length : at]))
    if at + 8 * doubles != end:
        raise MalformedBundleError(f"{end - at} bytes follow the items instead of {8 * doubles}")
    return Bundle(sequence, time_ns, items, np.frombuffer(payload, "<f8", doubles, at))


def session_config(listen: str | None, connect: str | None, router: bool = False) -> Any:
    """Zenoh settings of one session: explicit endpoints, no scouting.

    Args:
        listen: endpoint to listen at.
        connect: endpoint to connect to.
        router: ``connect`` is a router of the user's; join it as a client, with stock transport settings.
            Otherwise both ends are this project's, and the transport drops what costs latency.
    """
    import zenoh

    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "client" if router else "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
    }
    if not router:
        settings |= {
            "scouting/gossip/enabled": False,
            "transport/unicast/lowlatency": True,
            "transport/unicast/qos/enabled": False,
        }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def peer_config(where: str) -> Any:
    """Zenoh settings of a session that meets a run.

    Args:
        where: ``tcp/HOST:PORT``, where the run's own session listens; ``router:ENDPOINT``, a router that the run has
            joined; or ``config:FILE``, a configuration file of Zenoh's that the run uses as well. What such a file
            leaves out is off: no scouting, and no listening.

    Raises ValueError for a file that Zenoh does not read.
    """
    import zenoh

    kind, _, value = where.partition(":")
    if kind == "router":
        return session_config(None, value, router=True)
    if kind != "config":
        return session_config(None, where)
    try:
        config = zenoh.Config.from_file(value)
    except zenoh.ZError as error:
        raise ValueError(f"{value}: Zenoh cannot read it ({error})") from None
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled"):
        if config.get_json(key) == "null":
            config.insert_json5(key, "false")
    if config.get_json("listen/endpoints") == zenoh.Config().get_json("listen/endpoints"):
        config.insert_json5("listen/endpoints", "[]")
    return config


def declare_publisher(session: Any, key: str) -> Any:
    """A publisher on ``session`` that neither batches nor drops."""
    import zenoh

    return session.declare_publisher(
        key, express=True, congestion_control=zenoh.CongestionControl.BLOCK, priority=zenoh.Priority.REAL_TIME
    )
