"""The drive's state machine against the tables of CiA 402, every state with every controlword."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus.messages import Statusword
from joint_firmware.drive import POWERED, DriveState, transition

S = DriveState

# IEC 61800-7-201, "device control commands": bits that matter, and their values
COMMANDS = {
    "shutdown": (0b0111, 0b0110),
    "switch on": (0b1111, 0b0111),  # in OPERATION_ENABLED: "disable operation"
    "enable operation": (0b1111, 0b1111),
    "disable voltage": (0b0010, 0b0000),
    "quick stop": (0b0110, 0b0010),
}

# State, command: number of the transition, next state
TABLE = {
    (S.SWITCH_ON_DISABLED, "shutdown"): (2, S.READY_TO_SWITCH_ON),
    (S.READY_TO_SWITCH_ON, "switch on"): (3, S.SWITCHED_ON),
    (S.READY_TO_SWITCH_ON, "enable operation"): (3, S.SWITCHED_ON),  # 4 follows with the next command
    (S.SWITCHED_ON, "enable operation"): (4, S.OPERATION_ENABLED),
    (S.OPERATION_ENABLED, "switch on"): (5, S.SWITCHED_ON),
    (S.SWITCHED_ON, "shutdown"): (6, S.READY_TO_SWITCH_ON),
    (S.READY_TO_SWITCH_ON, "disable voltage"): (7, S.SWITCH_ON_DISABLED),
    (S.READY_TO_SWITCH_ON, "quick stop"): (7, S.SWITCH_ON_DISABLED),
    (S.OPERATION_ENABLED, "shutdown"): (8, S.READY_TO_SWITCH_ON),
    (S.OPERATION_ENABLED, "disable voltage"): (9, S.SWITCH_ON_DISABLED),
    (S.SWITCHED_ON, "disable voltage"): (10, S.SWITCH_ON_DISABLED),
    (S.SWITCHED_ON, "quick stop"): (10, S.SWITCH_ON_DISABLED),
    (S.OPERATION_ENABLED, "quick stop"): (11, S.QUICK_STOP_ACTIVE),
    (S.QUICK_STOP_ACTIVE, "disable voltage"): (12, S.SWITCH_ON_DISABLED),
}

words = st.integers(0, 0xFFFF)


def command_of(word: int) -> str:
    (name,) = (name for name, (mask, value) in COMMANDS.items() if word & mask == value)
    return name


@pytest.mark.parametrize("state", [s for s in S if s is not S.FAULT])
def test_every_controlword_does_what_the_table_says_and_no_other_does_anything(state: S) -> None:
    for word in range(0x200):
        _, expected = TABLE.get((state, command_of(word)), (None, state))
        for previous in (0, word, word ^ 0x80, 0xFFFF):
            assert transition(state, word, previous) is expected, f"{word:#06x} in {state.name}"


@given(words, words)
def test_a_fault_is_left_by_a_rising_edge_of_bit_7_alone(word: int, previous: int) -> None:
    rising = bool(word & 0x80) and not previous & 0x80
    assert transition(S.FAULT, word, previous) is (S.SWITCH_ON_DISABLED if rising else S.FAULT)


@given(st.sampled_from(list(S)), words, words)
def test_power_comes_by_enabling_a_switched_on_drive_and_in_no_other_way(
    state: S, word: int, previous: int
) -> None:
    if transition(state, word, previous) in POWERED and state not in POWERED:
        assert state is S.SWITCHED_ON and word & 0b1111 == 0b1111


@pytest.mark.parametrize(
    "state, pattern",
    [  # statusword bits 6 5 3 2 1 0 (x: does not matter), as CiA 402 prints them
        (S.NOT_READY, "0x0000"),
        (S.SWITCH_ON_DISABLED, "1x0000"),
        (S.READY_TO_SWITCH_ON, "010001"),
        (S.SWITCHED_ON, "010011"),
        (S.OPERATION_ENABLED, "010111"),
        (S.QUICK_STOP_ACTIVE, "000111"),
        (S.FAULT_REACTION_ACTIVE, "0x1111"),
        (S.FAULT, "0x1000"),
    ],
)
def test_statuswords_carry_the_bits_of_the_standard(state: S, pattern: str) -> None:
    bits = "".join(str(state >> bit & 1) for bit in (6, 5, 3, 2, 1, 0))
    assert all(expected in ("x", bit) for expected, bit in zip(pattern, bits, strict=True))
    assert state & ~Statusword.MASK == 0
