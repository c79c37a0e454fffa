"""Error counters of a CAN controller and what it tells of them (ISO 11898-1:2015, 12.1.4; ``linux/can/error.h``).

Transmit and receive error counter (TEC, REC) decide the state: a warning from 96, error passive from 128 of either,
bus off from 256 of TEC. The rules by their letters in the standard:

    a  a receiver detects an error                                            REC + 1
    b  a receiver sees a dominant bit right after its error flag              REC + 8
    c  a transmitter sends an error flag                                      TEC + 8
       but not: error passive, no acknowledgement, no dominant bit during its passive flag;
       but not: a recessive stuff bit in the arbitration field is seen dominant
    f  eight dominant bits after an error or overload flag, and each eight more  + 8
    g  a frame is sent                                                        TEC − 1
    h  a frame is received                                                    REC − 1, from above 127 to 127

What an application hears is encoded as the Linux drivers do: one frame per detected error (CAN_ERR_PROT with kind and
place, CAN_ERR_ACK, CAN_ERR_BUSERROR), one per change of state (CAN_ERR_CRTL, CAN_ERR_BUSOFF, CAN_ERR_RESTARTED), each
with the counters (CAN_ERR_CNT).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from bus.bitstream import Kind, ViolationError
from bus.frames import ErrorFrame

WARNING, PASSIVE, BUS_OFF = 96, 128, 256
_TOP = 255  # what a counter shows at most
_CLAMP = 127  # REC of an error passive receiver that receives a frame; the standard allows 119 … 127

ERR_CRTL, ERR_PROT, ERR_ACK, ERR_BUSOFF = 0x04, 0x08, 0x20, 0x40
ERR_BUSERROR, ERR_RESTARTED, ERR_CNT = 0x80, 0x100, 0x200
PROT_TX = 0x80
CRTL_ACTIVE = 0x40
_CRTL_RX, _CRTL_TX = (0, 0x04, 0x10), (0, 0x08, 0x20)  # by level: active, warning, passive


class State(IntEnum):
    """The first of the kernel's ``enum can_state`` (``linux/can/netlink.h``)."""

    ERROR_ACTIVE = 0
    ERROR_WARNING = 1
    ERROR_PASSIVE = 2
    BUS_OFF = 3


def _level(count: int) -> int:
    return 0 if count < WARNING else 1 if count < PASSIVE else 2


@dataclass(slots=True)
class Counters:
    """TEC and REC of one controller."""

    tec: int = 0
    rec: int = 0
    bus_off: bool = False

    @property
    def clear(self) -> bool:
        return not (self.tec or self.rec or self.bus_off)

    @property
    def passive(self) -> bool:
        return self.tec >= PASSIVE or self.rec >= PASSIVE

    @property
    def state(self) -> State:
        return State.BUS_OFF if self.bus_off else State(_level(max(self.tec, self.rec)))

    def transmit_error(self) -> None:
        """Rules c and f."""
        self.tec += 8
        if self.tec >= BUS_OFF:
            self.bus_off = True

    def receive_error(self, by: int = 1) -> None:
        """Rules a, b and f."""
        self.rec = min(self.rec + by, _TOP)

    def sent(self) -> None:
        """Rule g."""
        if self.tec:
            self.tec -= 1

    def received(self) -> None:
        """Rule h."""
        if self.rec:
            self.rec = self.rec - 1 if self.rec < PASSIVE else _CLAMP


def _frame(classes: int, counters: Counters, **at: int) -> ErrorFrame:
    data = bytearray(8)
    for place, value in at.items():
        data[int(place[1:])] = value
    data[6], data[7] = min(counters.tec, _TOP), min(counters.rec, _TOP)
    return ErrorFrame(classes | ERR_CNT, bytes(data))


def violation_frame(violation: ViolationError, transmitter: bool, counters: Counters) -> ErrorFrame:
    """A detected error."""
    classes = ERR_PROT | ERR_BUSERROR
    kind = violation.kind
    if kind is Kind.ACK:
        classes |= ERR_ACK
    shown = 0 if kind in (Kind.ACK, Kind.CRC) else int(kind)
    return _frame(classes, counters, d2=shown | (PROT_TX if transmitter else 0), d3=int(violation.field))


def state_frame(counters: Counters) -> ErrorFrame:
    """A state that was entered, as ``can_change_state`` of the kernel has it."""
    if counters.bus_off:
        return _frame(ERR_BUSOFF, counters)
    tx, rx = _level(counters.tec), _level(counters.rec)
    if not (tx or rx):
        return _frame(ERR_CRTL, counters, d1=CRTL_ACTIVE)
    return _frame(ERR_CRTL, counters, d1=(_CRTL_TX[tx] if tx >= rx else 0) | (_CRTL_RX[rx] if rx >= tx else 0))


def restarted_frame() -> ErrorFrame:
    """Back from bus off."""
    return _frame(ERR_RESTARTED, Counters())
