"""Error counters against the rules of the standard, error frames against the constants of ``linux/can/error.h``."""

import pytest

from bus.bitstream import Field, Kind, ViolationError
from bus.confinement import Counters, State, restarted_frame, state_frame, violation_frame

# linux/can/error.h
CAN_ERR_CRTL, CAN_ERR_PROT, CAN_ERR_ACK, CAN_ERR_BUSOFF = 0x4, 0x8, 0x20, 0x40
CAN_ERR_BUSERROR, CAN_ERR_RESTARTED, CAN_ERR_CNT = 0x80, 0x100, 0x200
CRTL_RX_WARNING, CRTL_TX_WARNING, CRTL_RX_PASSIVE, CRTL_TX_PASSIVE, CRTL_ACTIVE = 0x04, 0x08, 0x10, 0x20, 0x40
PROT_FORM, PROT_STUFF, PROT_BIT0, PROT_BIT1, PROT_TX = 0x02, 0x04, 0x08, 0x10, 0x80


@pytest.mark.parametrize("tec, rec, state, passive", [
    (0, 0, State.ERROR_ACTIVE, False), (95, 95, State.ERROR_ACTIVE, False), (96, 0, State.ERROR_WARNING, False),
    (0, 96, State.ERROR_WARNING, False), (127, 127, State.ERROR_WARNING, False), (128, 0, State.ERROR_PASSIVE, True),
    (0, 128, State.ERROR_PASSIVE, True), (255, 0, State.ERROR_PASSIVE, True), (0, 255, State.ERROR_PASSIVE, True),
])  # fmt: skip
def test_states_by_their_limits(tec: int, rec: int, state: State, passive: bool) -> None:
    counters = Counters(tec, rec)
    assert (counters.state, counters.passive) == (state, passive)


def test_a_transmitter_is_bus_off_after_32_errors_and_not_before() -> None:
    counters = Counters()
    for _ in range(31):
        counters.transmit_error()
    assert counters.state is State.ERROR_PASSIVE and counters.tec == 248
    counters.transmit_error()
    assert counters.state is State.BUS_OFF and counters.bus_off


def test_errors_of_receivers_never_lead_to_bus_off() -> None:
    counters = Counters()
    for _ in range(100):
        counters.receive_error(8)
    assert counters.state is State.ERROR_PASSIVE


def test_success_counts_down_to_zero_and_from_passive_at_once() -> None:
    counters = Counters(1, 2)
    counters.sent(), counters.sent(), counters.received(), counters.received(), counters.received()
    assert counters.clear
    far = Counters(0, 200)
    far.received()
    assert 119 <= far.rec <= 127 and far.state is State.ERROR_WARNING


@pytest.mark.parametrize("violation, transmitter, classes, kind, place", [
    ((Kind.STUFF, Field.DATA), False, CAN_ERR_PROT | CAN_ERR_BUSERROR, PROT_STUFF, 0x0A),
    ((Kind.FORM, Field.CRC_DELIMITER), False, CAN_ERR_PROT | CAN_ERR_BUSERROR, PROT_FORM, 0x18),
    ((Kind.BIT0, Field.SOF), True, CAN_ERR_PROT | CAN_ERR_BUSERROR, PROT_BIT0 | PROT_TX, 0x03),
    ((Kind.BIT1, Field.EOF), True, CAN_ERR_PROT | CAN_ERR_BUSERROR, PROT_BIT1 | PROT_TX, 0x1A),
    ((Kind.CRC, Field.CRC), False, CAN_ERR_PROT | CAN_ERR_BUSERROR, 0, 0x08),
    ((Kind.ACK, Field.ACK), True, CAN_ERR_PROT | CAN_ERR_BUSERROR | CAN_ERR_ACK, PROT_TX, 0x19),
])  # fmt: skip
def test_violations_as_socketcan_tells_them(
    violation: tuple[Kind, Field], transmitter: bool, classes: int, kind: int, place: int
) -> None:
    frame = violation_frame(ViolationError(*violation), transmitter, Counters(16, 9))
    assert frame.classes == classes | CAN_ERR_CNT
    assert frame.data == bytes([0, 0, kind, place, 0, 0, 16, 9])


@pytest.mark.parametrize("counters, flags", [
    (Counters(96, 0), CRTL_TX_WARNING), (Counters(0, 97), CRTL_RX_WARNING), (Counters(128, 100), CRTL_TX_PASSIVE),
    (Counters(0, 130), CRTL_RX_PASSIVE), (Counters(100, 100), CRTL_TX_WARNING | CRTL_RX_WARNING),
    (Counters(3, 7), CRTL_ACTIVE),
])  # fmt: skip
def test_states_as_socketcan_tells_them(counters: Counters, flags: int) -> None:
    frame = state_frame(counters)
    assert frame.classes == CAN_ERR_CRTL | CAN_ERR_CNT
    assert frame.data == bytes([0, flags, 0, 0, 0, 0, counters.tec, counters.rec])


def test_bus_off_and_restart_as_socketcan_tells_them() -> None:
    assert state_frame(Counters(256, 5, True)) == (CAN_ERR_BUSOFF | CAN_ERR_CNT, bytes([0, 0, 0, 0, 0, 0, 255, 5]))
    assert restarted_frame() == (CAN_ERR_RESTARTED | CAN_ERR_CNT, bytes(8))
