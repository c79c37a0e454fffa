"""The bundle's codec, and two processes that talk over the link's sessions."""

import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.zenoh_link import (
    IMU_SOURCE,
    MOTION_CAPTURE_SOURCE,
    MalformedBundleError,
    decode_bundle,
    encode_bundle,
    keys,
    session_config,
)

items_strategy = st.lists(
    st.tuples(st.integers(0, 2**62), st.sampled_from([0, 1, IMU_SOURCE, MOTION_CAPTURE_SOURCE]),
              st.integers(0, 2**29 - 1), st.binary(max_size=255)), max_size=10)  # fmt: skip
values_strategy = st.lists(st.floats(width=64), max_size=20)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**62), items_strategy, values_strategy)
def test_what_is_decoded_is_what_was_encoded(
    sequence: int, time_ns: int, items: list[tuple[int, int, int, bytes]], values: list[float]
) -> None:
    bundle = decode_bundle(encode_bundle(sequence, time_ns, items, np.array(values)))
    assert (bundle.sequence, bundle.time_ns, bundle.items) == (sequence, time_ns, items)
    assert bundle.values.dtype == np.float64
    assert bundle.values.tobytes() == np.array(values).tobytes()  # also NaN and -0


def test_the_layout_is_the_documented_one() -> None:
    payload = encode_bundle(7, 1000, [(900, 1, 0x181, b"\xaa\xbb")], np.array([1.0]))
    assert payload.hex() == (
        "484c" "02" "00" "07000000" "e803000000000000" "0100" "0100"
        "8403000000000000" "81010000" "01" "02" "aabb" "000000000000f03f"
    )  # fmt: skip


@given(items_strategy, values_strategy, st.data())
def test_a_cut_bundle_is_refused(
    items: list[tuple[int, int, int, bytes]], values: list[float], data: st.DataObject
) -> None:
    payload = encode_bundle(1, 2, items, np.array(values))
    with pytest.raises(MalformedBundleError):
        decode_bundle(payload[: data.draw(st.integers(0, len(payload) - 1))])
    with pytest.raises(MalformedBundleError):
        decode_bundle(payload + b"\0")


@given(st.binary(max_size=200))
def test_anything_else_is_refused_or_a_bundle(payload: bytes) -> None:
    for candidate in (payload, encode_bundle(1, 2, [])[:4] + payload):
        try:
            bundle = decode_bundle(candidate)
        except MalformedBundleError:
            continue
        assert encode_bundle(bundle.sequence, bundle.time_ns, bundle.items, bundle.values) == candidate


def test_another_version_is_named() -> None:
    payload = bytearray(encode_bundle(1, 2, []))
    payload[2] = 9
    with pytest.raises(MalformedBundleError, match="version 9"):
        decode_bundle(bytes(payload))


def test_keys_of_a_run() -> None:
    assert keys("r1") == ("hil/r1/state", "hil/r1/command", "hil/r1/inject", "hil/r1/telemetry", "hil/r1/status")


_ECHO = """
import sys, zenoh
from bus.zenoh_link import decode_bundle, encode_bundle, keys, session_config
with zenoh.open(session_config(None, sys.argv[1])) as session:
    names = keys("test")
    publisher = session.declare_publisher(names.command)
    inbox = session.declare_subscriber(names.state)
    bundle = decode_bundle(inbox.recv().payload.to_bytes())
    publisher.put(encode_bundle(bundle.sequence, bundle.time_ns, bundle.items))
    sys.stdin.read()
"""


def test_two_processes_exchange_bundles() -> None:
    import zenoh

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    answered = threading.Event()
    answers: list[bytes] = []
    ready = threading.Event()
    with zenoh.open(session_config(endpoint, None)) as session:
        names = keys("test")

        def receive(sample: zenoh.Sample) -> None:
            answers.append(sample.payload.to_bytes())
            answered.set()

        subscriber = session.declare_subscriber(names.command, receive)
        publisher = session.declare_publisher(names.state)
        listener = publisher.declare_matching_listener(
            lambda status: ready.set() if status.matching else None
        )
        process = subprocess.Popen([sys.executable, "-c", _ECHO, endpoint], stdin=subprocess.PIPE)
        try:
            assert ready.wait(20)
            payload = encode_bundle(3, 4, [(5, 1, 0x181, bytes(24))])
            publisher.put(payload)
            assert answered.wait(20)
            assert answers == [payload]
        finally:
            process.communicate(timeout=20)
            listener.undeclare()
            subscriber.undeclare()
    assert process.returncode == 0


def test_a_session_towards_a_router_is_a_stock_client() -> None:
    ours = session_config(None, "tcp/127.0.0.1:7447")
    stock = session_config(None, "tcp/127.0.0.1:7447", router=True)
    assert (ours.get_json("mode"), stock.get_json("mode")) == ('"peer"', '"client"')
    assert ours.get_json("transport/unicast/lowlatency") == "true"
    assert stock.get_json("transport/unicast/lowlatency") == "false"
    for config in (ours, stock):
        assert config.get_json("scouting/multicast/enabled") == "false"
