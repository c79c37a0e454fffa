"""What is not of its length, or no command of an existing bus, does not pass the gateway, and is counted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus import messages
from bus.frames import CAN_FD_LENGTHS, Frame
from bus.gateway import Gateway
from robots import description

ROBOT = description.load("hume")


@given(st.sampled_from(CAN_FD_LENGTHS), st.sampled_from([messages.STATE, messages.EMERGENCY]))
def test_a_frame_of_the_wrong_length_is_counted_not_forwarded(length: int, base: int) -> None:
    gateway = Gateway(ROBOT)
    right = messages.STATE_LENGTH if base == messages.STATE else messages.EMERGENCY_LENGTH
    frame = Frame(base + ROBOT.joints_of(ROBOT.buses[0])[0].node_id, bytes(length))
    forwarded = gateway.from_can(0, 0, frame)
    assert (forwarded is not None) == (length == right)
    assert (gateway.ignored, gateway.malformed) == (0, int(length != right))


@pytest.mark.parametrize("item", [
    (2, messages.COMMAND, bytes(64)), (255, messages.COMMAND, bytes(64)), (0, messages.STATE + 1, bytes(64)),
    (0, messages.COMMAND, bytes(63)), (0, messages.COMMAND, b""), (0, 2**31, bytes(64)),
])  # fmt: skip
def test_what_is_no_command_is_refused_and_counted(item: tuple[int, int, bytes]) -> None:
    gateway = Gateway(ROBOT)
    with pytest.raises(messages.MalformedMessageError, match="no command"):
        gateway.from_link(item)
    assert gateway.malformed == 1
