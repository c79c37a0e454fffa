"""The drive's state machine (CiA 402): which controlword leads from where to where."""

from __future__ import annotations

from enum import IntEnum

from bus.messages import Controlword, Statusword


class DriveState(IntEnum):
    """States of CiA 402; the value is the statusword under its mask."""

    NOT_READY = Statusword.NOT_READY
    SWITCH_ON_DISABLED = Statusword.SWITCH_ON_DISABLED
    READY_TO_SWITCH_ON = Statusword.READY_TO_SWITCH_ON
    SWITCHED_ON = Statusword.SWITCHED_ON
    OPERATION_ENABLED = Statusword.OPERATION_ENABLED
    QUICK_STOP_ACTIVE = Statusword.QUICK_STOP_ACTIVE
    FAULT_REACTION_ACTIVE = Statusword.FAULT_REACTION_ACTIVE
    FAULT = Statusword.FAULT


# a tuple: to look for a member of an Enum in a set costs a call of its __hash__
POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)

_S = DriveState


def transition(state: DriveState, controlword: int, previous: int) -> DriveState:
    """State after ``controlword`` in ``state``; ``previous`` is the controlword before it.

    Bits: 0 switch on, 1 enable voltage, 2 quick stop (active low), 3 enable operation, 7 fault reset.
    In FAULT the rising edge of bit 7 counts; elsewhere the bit does not matter, so that it masks no stop.
    """
    if state in (_S.NOT_READY, _S.FAULT_REACTION_ACTIVE):
        return state  # left by the drive alone
    if state is _S.FAULT:
        rising = controlword & ~previous & Controlword.FAULT_RESET
        return _S.SWITCH_ON_DISABLED if rising else state
    if not controlword & 0b0010:  # disable voltage
        return _S.SWITCH_ON_DISABLED
    if not controlword & 0b0100:  # quick stop
        stops = state in (_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE)
        return _S.QUICK_STOP_ACTIVE if stops else _S.SWITCH_ON_DISABLED
    if state is _S.QUICK_STOP_ACTIVE:
        return state  # only through disable voltage, or into fault
    command = controlword & 0b1111
    if command & 0b0111 == Controlword.SHUTDOWN:
        return _S.READY_TO_SWITCH_ON
    if command == Controlword.SWITCH_ON:
        return state if state is _S.SWITCH_ON_DISABLED else _S.SWITCHED_ON
    if command == Controlword.ENABLE_OPERATION:
        if state in (_S.SWITCHED_ON, _S.OPERATION_ENABLED):
            return _S.OPERATION_ENABLED
        return _S.SWITCHED_ON if state is _S.READY_TO_SWITCH_ON else state
    return state
