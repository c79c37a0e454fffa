"""A drive as a CANopen node (CiA 301): NMT, heartbeat, SYNC, emergencies, SDO. It starts without a master.

Nothing here runs in a tick without a service: ``due`` tells the interrupt when it must call.
"""

from __future__ import annotations

from typing import Any, Protocol

from bus import messages
from bus.drive_faults import EMERGENCIES, DriveFault
from bus.frames import Frame
from bus.messages import NmtCommand, NmtState
from joint_firmware.object_dictionary import AbortCode, ObjectDictionary, SdoAbort
from joint_firmware.objects import HISTORY
from joint_firmware.sdo import NEVER, SdoServer

SDO_TIMEOUT_S = 5.0  # a person's debugger may be behind the client, and virtual time faster than it
_EVENT_DRIVEN = 254  # transmission types from here on: sent when the drive sees fit
_SYNCHRONOUS = 240  # greatest transmission type that counts SYNCs


class Application(Protocol):
    """The drive, as its communication sees it."""

    def booted(self) -> None: ...
    def stop(self, sent: list[Frame]) -> None: ...
    def reset(self) -> None: ...
    def report(self, tick: int) -> bytes: ...


class Communication:
    """The services of one node.

    ``report_ticks`` between two reports: heartbeats are sent on ticks without a report, and by each node at another
    one, so their period is rounded to a multiple of it.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        application: Application,
        rate: float,
        boot_ticks: int,
        report_ticks: int,
        heartbeat_period: float,
    ) -> None:
        node_id = dictionary.node_id
        self._application = application
        self._node_id = node_id
        self._state_id = messages.STATE + node_id
        self._heartbeat_id = messages.HEARTBEAT + node_id
        self._emergency_id = messages.EMERGENCY + node_id
        self._request_id = messages.SDO_REQUEST + node_id
        self._response_id = messages.SDO_RESPONSE + node_id
        self._rate, self._boot_ticks, self._report_ticks = rate, boot_ticks, report_ticks
        self._default_heartbeat = heartbeat_period
        self._sdo = SdoServer(dictionary, round(SDO_TIMEOUT_S * rate))
        self._history: list[int] = []
        self.error_register = 0
        self.malformed = 0
        self._untold = False  # an emergency waits for the node to be allowed to send it
        self._power_on(0, boot_ticks)
        self._connect(dictionary)

    def _power_on(self, tick: int, boot_ticks: int) -> None:
        """Communication as after power-on; the boot-up message is sent ``boot_ticks`` after ``tick``."""
        self._tick = tick
        self._boot_tick = tick + boot_ticks
        self._transmission_type = 255
        self._syncs = 0  # since the last report
        self._report_due = False
        self._enter(NmtState.INITIALISING)
        self._answer = Frame(self._response_id, b"", False, False)  # in the form of the last request
        self._sdo.close()
        self._set_heartbeat(self._default_heartbeat)

    # --- objects --------------------------------------------------------------------------------------------

    def _connect(self, dictionary: ObjectDictionary) -> None:
        dictionary.connect(0x1001, 0, lambda: self.error_register)
        dictionary.connect(0x1003, 0, lambda: len(self._history), lambda _: self._history.clear())
        for n in range(HISTORY):
            dictionary.connect(0x1003, n + 1, lambda n=n: self._past_error(n))  # type: ignore[misc]
        dictionary.connect(0x1017, 0, lambda: round(self._heartbeat_period * 1e3), self._write_heartbeat)
        dictionary.connect(0x1800, 2, lambda: self._transmission_type, self._write_transmission_type)

    def _past_error(self, n: int) -> int:
        if n >= len(self._history):
            raise SdoAbort(AbortCode.NO_DATA)
        return self._history[n]

    def _write_heartbeat(self, milliseconds: float) -> None:
        self._set_heartbeat(milliseconds * 1e-3)

    def _write_transmission_type(self, value: float) -> None:
        if _SYNCHRONOUS < value < _EVENT_DRIVEN:  # reserved, or for remote requests
            raise SdoAbort(AbortCode.VALUE)
        self._transmission_type = int(value)
        self._syncs = 0
        self._enter(self.state)

    def _set_heartbeat(self, period: float) -> None:
        self._heartbeat_period = period
        ticks = max(round(period * self._rate), self._report_ticks)
        self._heartbeat_ticks = ticks + (-ticks) % self._report_ticks
        self._plan_heartbeat(self._tick)
        self._plan()

    # --- what the interrupt calls ---------------------------------------------------------------------------

    def receive(self, frame: Frame, tick: int, sent: list[Frame]) -> None:
        """A frame that is not the command: NMT, SYNC, an SDO request, or nothing for this node."""
        if frame.extended or frame.remote or self.state == NmtState.INITIALISING:
            return
        self._tick = tick
        if frame.id == self._request_id:
            if self.state == NmtState.STOPPED:
                return
            if len(frame.data) != 8:
                self.malformed += 1
                return
            self._answer = Frame(self._response_id, b"", frame.fd, frame.brs)
            answer = self._sdo.request(frame.data, tick)
            if answer is not None:
                sent.append(self._answer._replace(data=answer))
        elif frame.id == messages.NMT:
            self._obey(frame.data, tick, sent)
        elif frame.id == messages.SYNC:
            self._synchronise(frame.data)
        self._plan()

    def serve(self, tick: int, sent: list[Frame]) -> None:
        """What has become due: boot-up, heartbeat, synchronous report, the end of an SDO client's patience."""
        if self.state == NmtState.INITIALISING:
            if tick >= self._boot_tick:
                self._application.booted()
                sent.append(Frame(self._heartbeat_id, bytes([NmtState.INITIALISING])))
                self._plan_heartbeat(tick)
                self._enter(NmtState.OPERATIONAL)
                self._catch_up(sent)
        elif tick >= self._heartbeat_tick:
            sent.append(Frame(self._heartbeat_id, bytes([self.state])))
            self._plan_heartbeat(tick)
        if self._report_due:
            self._report_due = False
            sent.append(Frame(self._state_id, self._application.report(tick)))
        if tick >= self._sdo.deadline:
            sent.append(self._answer._replace(data=self._sdo.expire()))
        self._plan()

    def emergency(self, fault: DriveFault, sent: list[Frame]) -> None:
        """Note a fault (or NONE, when the last one is gone) and tell it, as soon as the node may."""
        code = EMERGENCIES[fault].code
        self.error_register = EMERGENCIES[fault].registers
        if code:
            self._history.insert(0, code)
            del self._history[HISTORY:]
        self._untold = True
        self._catch_up(sent)

    def _catch_up(self, sent: list[Frame]) -> None:
        if self._untold and self.state not in (NmtState.INITIALISING, NmtState.STOPPED):
            self._untold = False
            code = self._history[0] if self.error_register and self._history else EMERGENCIES[DriveFault.NONE].code
            sent.append(Frame(self._emergency_id, messages.encode_emergency(code, self.error_register)))

    # --- services -------------------------------------------------------------------------------------------

    def _obey(self, data: bytes, tick: int, sent: list[Frame]) -> None:
        if len(data) != 2:
            self.malformed += 1
            return
        command, node_id = data
        if node_id not in (0, self._node_id):
            return
        if command == NmtCommand.START:
            self._enter(NmtState.OPERATIONAL)
        elif command == NmtCommand.ENTER_PRE_OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
        elif command == NmtCommand.STOP:
            self._application.stop(sent)  # before the state forbids to say why
            self._sdo.close()
            self._enter(NmtState.STOPPED)
        elif command == NmtCommand.RESET_NODE:
            self._history.clear()
            self.error_register = self.malformed = 0
            self._untold = False
            self._power_on(tick, self._boot_ticks)
            self._application.reset()
        elif command == NmtCommand.RESET_COMMUNICATION:
            self._application.stop(sent)
            self._power_on(tick, 0)
        self._catch_up(sent)

    def _enter(self, state: int) -> None:
        self.state = state
        self.listening = state == NmtState.OPERATIONAL  # whether commands are heard
        # whether the state is sent at every report tick
        self.reporting = self.listening and self._transmission_type >= _EVENT_DRIVEN
        self._report_due = self._report_due and self.listening

    def _synchronise(self, data: bytes) -> None:
        if data:  # a SYNC counts only where 0x1019 says so, and there is none
            self.malformed += 1
            return
        if self.state == NmtState.OPERATIONAL and self._transmission_type <= _SYNCHRONOUS:
            self._syncs += 1
            if self._syncs >= self._transmission_type:  # 0: at any SYNC, for there is always a new sample
                self._syncs = 0
                self._report_due = True

    def _plan_heartbeat(self, tick: int) -> None:
        """The next tick that is this node's own slot in the period."""
        if not self._heartbeat_period:
            self._heartbeat_tick = NEVER
            return
        period = self._heartbeat_ticks
        slot = 1 if self._report_ticks > 1 else 0
        phase = (slot + self._report_ticks * self._node_id) % period
        self._heartbeat_tick = tick + 1 + (phase - tick - 1) % period

    def _plan(self) -> None:
        if self._report_due:
            self.due = 0
        elif self.state == NmtState.INITIALISING:
            self.due = self._boot_tick
        else:
            self.due = min(self._heartbeat_tick, self._sdo.deadline)

    # --- state ----------------------------------------------------------------------------------------------

    _PLAIN = (
        "state", "listening", "reporting", "due", "error_register", "malformed", "_tick", "_boot_tick",
        "_transmission_type", "_syncs", "_report_due", "_untold", "_answer", "_heartbeat_period", "_heartbeat_ticks",
        "_heartbeat_tick",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        plain = {name: getattr(self, name) for name in self._PLAIN}
        return {**plain, "history": tuple(self._history), "sdo": self._sdo.snapshot()}

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self._history = list(state["history"])
        self._sdo.restore(state["sdo"])
