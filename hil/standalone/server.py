"""A bus by itself: one wire in the time of the monotonic clock, with a port for every client that attaches.

A frame is offered to the wire when it is read from its client, and delivered at the end of its frame time. The wire
computes in its own exact time; a loop that runs late delivers late, with the right time stamps, and says so.
"""

from __future__ import annotations

import ctypes
import os
import selectors
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from bus.config import BusConfig
from bus.link import NEVER
from bus.records import ControllerState, pack_error
from bus.talkers import Babbler, BackgroundTraffic, Talker
from bus.wire import Wire
from hil.lateness import Lateness
from hil.standalone.clients import ClientPorts, PortClient
from hil.standalone.faults import ClientFaults
from hil.standalone.record import Record
from hil.streams import streams

MAX_CLIENTS = 32
_FLUSH_NS = 100_000_000
_LOAD_SAMPLES = 11  # one per flush: the load of the last second
_AT_A_TIME = 64  # events on the wire that are caught up with before the clients are looked at
_SPIN_NS = 40_000  # a sleeper wakes this much too late: sleep short, then look again and again
_PR_SET_TIMERSLACK = 29


class _Requests(deque[Callable[[], None]]):
    """What other threads want done; to append something wakes the loop."""

    def __init__(self) -> None:
        super().__init__()
        self.bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def append(self, request: Callable[[], None]) -> None:
        super().append(request)
        os.eventfd_write(self.bell, 1)


class StandaloneBus:
    """The bus ``name``. ``serve`` runs it until ``stop`` is called, which a signal handler may do.

    Raises bus.ports.PortError when the name is taken.
    """

    def __init__(
        self, name: str, config: BusConfig, fd: bool = True, endpoint: str | None = None, seed: int = 0
    ) -> None:
        self.name, self.config, self.fd = name, config, fd
        self.now_ns = 0  # bus time
        self.requests = _Requests()
        self.injected: list[dict[str, Any]] = []
        self.lateness = Lateness()  # of deliveries
        self.misfits = 0  # CAN FD frames for a classical bus: its controllers could not send them
        random = streams(seed)
        self._wire = Wire(name, config, MAX_CLIENTS + 2, random)
        self._clientless = MAX_CLIENTS + 1  # a port that no client gets
        babbler = Babbler(self._wire, MAX_CLIENTS, config.babble, fd)
        background = BackgroundTraffic(self._wire, MAX_CLIENTS + 1, config, random, fd)
        self._talkers: tuple[Talker, ...] = (babbler, background)
        self._faults = ClientFaults(
            name, self._wire, {"babble": (babbler, MAX_CLIENTS), "background": (background, MAX_CLIENTS + 1)},
            range(MAX_CLIENTS), config,
        )  # fmt: skip
        self._ports = ClientPorts(
            name, MAX_CLIENTS, endpoint, fd=fd, arbitration_rate=config.arbitration_rate,
            data_rate=config.data_rate,
        )  # fmt: skip
        self.record: Record | None = None
        self._busy_clients: set[PortClient] = set()  # who has frames in the wire
        self._leaving: list[PortClient] = []  # who has left while a frame of its was under way
        self._look_at = NEVER  # when a client wants to be looked after that has sent nothing
        self._flush_at = NEVER
        self._busy = deque([(0, 0)], maxlen=_LOAD_SAMPLES)  # time, busy time of the wire
        self._stopped = False
        self._origin = time.monotonic_ns()
        self._started = time.time()
        self._selector = selectors.SelectSelector()  # the only one that sleeps to the microsecond
        self._selector.register(self._ports, selectors.EVENT_READ, None)
        self._selector.register(self.requests.bell, selectors.EVENT_READ, None)
        # Python runs a signal's handler between two of its instructions: a signal that comes just before the wait would
        # wait with it, but for what its C part writes here (signal.set_wakeup_fd).
        self._signalled, self.wakeup_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._selector.register(self._signalled, selectors.EVENT_READ, None)

    def stop(self) -> None:
        """Let ``serve`` return."""
        if not self._stopped:
            self._stopped = True
            os.eventfd_write(self.requests.bell, 1)

    def serve(self) -> None:
        """Run the bus."""
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # wake when told, not 50 µs later
        select = self._selector.select
        while not self._stopped:
            now = time.monotonic_ns() - self._origin
            upcoming = self._upcoming()
            if upcoming <= now:
                self._advance(upcoming, now)
                upcoming = self._upcoming()  # a loop that is late still looks at its sockets
            if now >= self._flush_at:
                self._flush(now)
            if now >= self._look_at:
                self._look()
            upcoming = min(upcoming, self._flush_at, self._look_at)
            if upcoming == NEVER:
                ready = select()
            else:
                ready = select(max(upcoming - now - _SPIN_NS, 0) * 1e-9)
            if ready:
                self._attend(ready)
        self.now_ns = time.monotonic_ns() - self._origin

    def _upcoming(self) -> int:
        """Time of the next event on the wire, or of the next frame of a talker."""
        return min(self._wire.next_ns, *[talker.next_ns for talker in self._talkers])

    def _advance(self, due: int, now: int) -> None:
        """The events of the time ``due``, looked at at ``now``."""
        self.now_ns = due
        wire, ports = self._wire, self._ports
        for talker in self._talkers:
            if talker.next_ns <= due:
                talker.advance(due)
        deliveries = wire.advance(due)
        for delivery in deliveries:
            time_ns, frame = delivery.time, delivery.frame
            self.lateness.add(now - due)
            ports.deliver(time_ns, delivery.sender, frame, delivery.missed)
            if self.record is not None:
                self.record.frame(time_ns, frame)
            if self._flush_at == NEVER:
                self._flush_at = now + _FLUSH_NS
        for at, port, error in wire.error_frames():
            if port in ports.attached:
                ports.attached[port].give(pack_error(error, at, port))
                self._tell_state(ports.attached[port])
            # of the ports without a client one speaks for all
            if self.record is not None and (port in ports.attached or port == self._clientless):
                self.record.frame(at, error)
        self._tell_given_up(due)
        for client in tuple(self._busy_clients):
            if client.in_wire > wire.waiting(client.port):
                client.completed(due, [delivery.frame for delivery in deliveries if delivery.sender == client.port])
                self._serve(client, due)
        if self._leaving:
            leaving, self._leaving = self._leaving, []
            for client in leaving:
                self._unplug(client, due)

    def _tell_given_up(self, now: int) -> None:
        for port, frame in self._wire.given_up():
            client = self._ports.attached.get(port)
            if client is not None:
                client.given_up(frame, now)
                self._serve(client, now)

    def _attend(self, ready: list[tuple[selectors.SelectorKey, int]]) -> None:
        """Sockets that have something. All frames of one look are offered at the same instant, and arbitrate."""
        now = self._catch_up()
        for key, _ in ready:
            if key.fileobj is self._ports:
                for new in self._ports.accept():
                    self._faults.plug(new.port, now)
                    self._selector.register(new.socket, selectors.EVENT_READ, new)
            elif key.fileobj == self._signalled:
                os.read(self._signalled, 64)
            elif key.data is None:
                os.eventfd_read(self.requests.bell)
                while self.requests:
                    self.requests.popleft()()
            else:
                client: PortClient = key.data
                client.hear(now)
                if client.left:
                    self._selector.unregister(client.socket)
                self._serve(client, now)

    def _catch_up(self) -> int:
        """The time now, with what has happened on the wire before it done; or, of a wire that takes longer to compute
        than to wait for, as far as it has come: its clients must not wait for that."""
        now = max(time.monotonic_ns() - self._origin, self.now_ns)
        for _ in range(_AT_A_TIME):
            due = self._upcoming()
            if due >= now:
                self.now_ns = now
                break
            self._advance(due, now)
        return self.now_ns

    def _serve(self, client: PortClient, now: int) -> None:
        """Offer what ``client`` wants on the bus, as far as its transmit queue has room."""
        wire, port = self._wire, client.port
        frames = client.due(now)
        if not client.left:
            self._tell_state(client)
        elif client.faults or client.starved:
            client.abandon()
            frames = []
        for frame in frames:
            if frame.fd and not self.fd:
                self.misfits += 1
                client.given_up(frame, now)
            elif not wire.offer(now, port, frame):
                client.refused(frame)
        if client.in_wire:
            self._busy_clients.add(client)
        else:
            self._busy_clients.discard(client)
            if client.left and client.idle:
                self._unplug(client, now)
        self._look_at = min(self._look_at, client.next_ns())

    def _unplug(self, client: PortClient, now: int) -> None:
        """Take a client that has left off the wire, with its faults."""
        if self._ports.attached.get(client.port) is not client:
            return
        if client.faults:
            self.log(f"{client.node} has left, and with it {', '.join(client.faults)}")
            client.faults.clear()
        if self._faults.unplug(client.port, now):
            self._ports.release(client)
        elif client not in self._leaving:
            self._leaving.append(client)

    def _tell_state(self, client: PortClient) -> None:
        client.tell_state(ControllerState(*self._wire.ports_state(client.port)))

    def _look(self) -> None:
        """Serve those who want to be looked after though they have sent nothing: periodic frames are due."""
        now = self._catch_up()
        self._look_at = NEVER
        for client in tuple(self._ports.attached.values()):
            if client.next_ns() <= now:
                self._serve(client, now)
            else:
                self._look_at = min(self._look_at, client.next_ns())

    def _flush(self, now: int) -> None:
        self._busy.append((now, self._wire.busy_ns))
        self._flush_at = NEVER  # until the next frame
        if self.record is not None:
            self.record.flush()

    def inject(self, key: str, value: str | float) -> Any:
        """Change one impairment from now on. Returns its value in SI units; raises UserError for a wrong one."""
        parsed, client = self._faults.set(key, value, self._ports.attached.values(), self.now_ns)
        entry = {"time_s": self.now_ns * 1e-9, "key": key, "value": str(value)}
        whose = ""
        if client is not None:
            entry |= {"process": client.process, "pid": client.pid}
            whose = f" ({client.process}, {client.pid})"
        self.injected.append(entry)
        self.log(f"injected {key} = {value}{whose}")
        return parsed

    def _summary(self, client: PortClient) -> dict[str, Any]:
        tec, rec, state = self._wire.ports_state(client.port)
        return {**client.summary(), "state": state.name.lower().replace("_", " "), "tec": tec, "rec": rec}

    def log(self, sentence: str) -> None:
        """Write what happened now into the record."""
        if self.record is not None:
            self.record.event(self.now_ns, sentence)

    def load(self) -> float:
        """Share of the last second that the bus was busy."""
        now, busy = time.monotonic_ns() - self._origin, self._wire.busy_ns
        since, before = self._busy[0]
        for sample in self._busy:
            if sample[0] <= now - 1_000_000_000:
                since, before = sample
        return min((busy - before) / max(min(now - since, 1_000_000_000), 1), 1.0)

    def status(self) -> dict[str, Any]:
        """Everything about the bus, for people and machines; times in s, rates in bit/s, lateness in µs."""
        wire, record = self._wire, self.record
        uptime = (time.monotonic_ns() - self._origin) * 1e-9
        identifiers = {}
        for (identifier, extended), traffic in wire.traffic().items():
            wait = traffic.wait
            identifiers[f"{identifier:08X}" if extended else f"{identifier:03X}"] = {
                "sent": traffic.sent,
                "lost": traffic.lost,
                "retransmitted": traffic.retransmitted,
                "wait_p50_us": round(wait.percentile(50) * 1e-3, 1),
                "wait_p99_us": round(wait.percentile(99) * 1e-3, 1),
                "wait_max_us": round(wait.longest * 1e-3, 1),
            }
        return {
            "name": self.name,
            "pid": os.getpid(),
            "fd": self.fd,
            "arbitration_rate": self.config.arbitration_rate,
            "data_rate": self.config.data_rate if self.fd else None,
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(self._started)),
            "uptime": round(uptime, 3),
            "load": round(self.load(), 4),
            "load_mean": round(min(wire.busy_ns * 1e-9 / uptime, 1.0), 6),
            "sent": wire.sent,
            "lost": wire.lost,
            "errors": wire.errors,
            "collisions": wire.collisions,
            "misfits": self.misfits,
            "identifiers": identifiers,
            "clients": [self._summary(client) for client in self._ports.attached.values()],
            "lateness": self.lateness.summary(),
            "injected": self.injected,
            "log": None if record is None else str(record.directory),
            "log_failure": None if record is None else record.failure,
        }

    def close(self) -> None:
        """Detach all clients and give up the name. Raises nothing."""
        self._stopped = True
        self._selector.close()
        self._ports.close()
        for descriptor in (self.requests.bell, self._signalled, self.wakeup_fd):
            os.close(descriptor)
