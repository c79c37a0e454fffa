"""Records: read back, and any bytes taken at either end of a socket."""

import os
import socket

import can
from hypothesis import given, settings
from hypothesis import strategies as st

from bus.can_messages import to_frame, to_message
from bus.frames import Frame, checked
from bus.ports import PortServer
from bus.records import (
    FLUSH,
    HEADER,
    MalformedRecordError,
    kind_and_tag,
    pack_frame,
    pack_note,
    unpack_frame,
)
from tests.support.ports import RUN, attached, frames


@given(frames(), st.integers(0, 2**62), st.integers(0, 255))
def test_a_record_is_read_back(frame: Frame, time_ns: int, sender: int) -> None:
    assert unpack_frame(pack_frame(frame, time_ns, sender)) == (time_ns, sender, frame)


@given(st.binary(max_size=90))
def test_any_other_bytes_are_refused_or_a_record(record: bytes) -> None:
    try:
        time_ns, sender, frame = unpack_frame(record)
    except MalformedRecordError:
        return
    kind, tag = kind_and_tag(record)
    again = pack_frame(frame, time_ns, sender, kind, tag)
    assert again == record or (frame.remote and again[: HEADER.size] == record[: HEADER.size])


@given(frames(), st.integers(0, 10**15))
def test_frames_and_messages_are_two_forms_of_one_thing(frame: Frame, time_ns: int) -> None:
    message = to_message(frame, time_ns, "x")
    message._check()
    assert to_frame(message) == frame and round(message.timestamp * 1e9) == time_ns


@given(st.lists(st.one_of(st.binary(max_size=200), frames().map(pack_frame), st.tuples(
    st.binary(min_size=16, max_size=16), st.integers(0, 9), st.binary(min_size=3, max_size=80),
).map(lambda parts: parts[0] + bytes([parts[1]]) + parts[2])), max_size=30))  # fmt: skip
@settings(deadline=None, max_examples=60)
def test_a_server_takes_any_records(records: list[bytes]) -> None:
    """It never fails, hands over only what a controller could send, and goes on serving."""
    server = PortServer("fuzz", run=RUN)
    try:
        raw = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        raw.connect(f"\0hume-hil/{os.getuid()}/{RUN}/fuzz")
        with raw:
            for now, record in enumerate(records):
                raw.send(record or b"x")  # nothing would mean that it leaves
                for frame in server.poll(now * 10**6):
                    assert checked(frame) is frame
                    server.broadcast(now * 10**6, 1, frame)
            raw.send(pack_note(FLUSH))
            server.poll(10**12)
            raw.send(pack_frame(Frame(0x123, b"\x01"), tag=7))
            handed = [frame for step in range(9) for frame in server.poll((2000 + step) * 10**9)]
            assert Frame(0x123, b"\x01") in handed
        server.poll(10**14)
        assert server.clients == 0
    finally:
        server.close()


@given(st.lists(st.one_of(st.binary(min_size=1, max_size=100), frames().map(pack_frame), st.tuples(
    st.binary(min_size=16, max_size=16), st.integers(0, 9), st.binary(min_size=3, max_size=80),
).map(lambda parts: parts[0] + bytes([parts[1]]) + parts[2])), max_size=30))  # fmt: skip
@settings(deadline=None, max_examples=60)
def test_a_client_takes_any_records(records: list[bytes]) -> None:
    server = PortServer("fuzz", run=RUN)
    try:
        with attached(server, channel=f"{RUN}/fuzz") as bus:
            (client,) = server._clients
            for record in records:
                client.socket.send(record)
                received = bus.recv(0)
                assert received is None or isinstance(received, can.Message)
            while bus.recv(0) is not None:
                pass
            server.broadcast(5, 1, Frame(0x123, b"\x01"))
            last = bus.recv(1.0)
            assert last is not None and (last.arbitration_id, last.timestamp) == (0x123, 5e-9)
            assert bus.state in can.BusState
    finally:
        server.close()
