"""What a wire is made of, and what happens on it when not all is well: collisions, errors, faults.

The short way of a frame is in ``bus.wire``; what becomes of an attempt that may fail is decided by ``bus.nodes``.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from bus.bitstream import encode
from bus.config import BusConfig
from bus.confinement import State
from bus.frames import Frame
from bus.impairment import ImpairmentModel, Line
from bus.link import NEVER
from bus.nodes import Event, Nodes, Outcome
from bus.timing import INTERMISSION, TAIL, BitRates
from bus.traffic import Traffic, Wait

QUEUE = 32  # frames that wait in one port's controller, as many as an M_CAN has transmit buffers
_UNREAD = 1024  # error frames that are kept for who fetches them
_INTEGRATION = 11  # recessive bits after which a node takes the bus for idle

# priority, port, order, offered at, frame, its bits before the tail at either rate
Entry = tuple[int, int, int, int, Frame, int, int]
_Key = tuple[int, bool]  # identifier, extended
# ends at, start, the frame on the short way, or else all that take part with the outcome
Sending = tuple[int, int, Entry | None, tuple[dict[int, Entry], Outcome] | None]


class PortState(NamedTuple):
    """Error counters and state of one node."""

    tec: int
    rec: int
    state: State


class Delivery(NamedTuple):
    """A frame that reaches the ports of a bus at ``time`` ns, all but its sender's and those that ``missed`` it."""

    time: int
    sender: int
    frame: Frame
    missed: int = 0  # bit n is set for a port n that is cut or bus off, or has seen an error in the frame


def _changed(delivery: Delivery, change: Callable[[bytes], bytes]) -> Delivery:
    frame = delivery.frame
    data = change(frame.data)
    if data is frame.data:
        return delivery
    return delivery._replace(frame=frame._replace(data=data))


class Medium:
    """State, statistics and faults of a wire; the base of ``bus.wire.Wire``."""

    def __init__(self, name: str, config: BusConfig, ports: int, streams: Callable[[str], Any]) -> None:
        self.name = name
        self.ports = ports
        self._rates = BitRates(config.arbitration_rate, config.data_rate)
        self._intermission_ns = self._rates.ns(INTERMISSION)
        self._integration_ns = self._rates.ns(_INTEGRATION)
        self._impairment = ImpairmentModel(f"bus.{name}", config, streams)
        self._nodes = Nodes(ports, self._rates, config.bus_off_recovery == "automatic")
        self._fifo = config.queue == "fifo"
        self._waiting: list[Entry] = []  # a heap: its first entry wins the next arbitration
        self._behind: list[deque[Entry]] = [deque() for _ in range(ports)]  # FIFO only: all but the first
        self._queued = [0] * ports
        self._order = 0
        self._free_at = 0  # the bus is idle from here on
        self._sending: Sending | None = None
        self._jammed_since = NEVER
        self._line = Line(self._impairment, _changed)  # impaired deliveries
        self._foretold: list[Event] = []  # by time: what controllers will tell in the course of an error
        self.told: deque[Event] = deque(maxlen=_UNREAD)  # by nodes' controllers: what ``error_frames`` fetches
        self._armed: dict[_Key, list[tuple[int, int | str, int | None]]] = {}  # damage to come
        self._withdrawn: set[int] = set()  # orders of the frames under way that are not sent again
        self._given_up: deque[tuple[int, Frame]] = deque(maxlen=_UNREAD)
        self._traffic: dict[_Key, Traffic] = {}
        self.busy_ns = 0
        self.sent = 0
        self.lost = 0
        self.errors = 0  # frames that ended in an error frame
        self.refused = 0  # offered to a full transmit queue
        self.dropped = 0  # given up: in one-shot mode, or withdrawn
        self.collisions = 0  # attempts of several ports with the same identifier
        self.next_ns = NEVER  # when ``advance`` has something to do; NEVER: the bus is idle, nothing is under way

    def _schedule(self) -> None:
        """Set ``next_ns``."""
        raise NotImplementedError

    # --- frames that got through --------------------------------------------------------------------------------

    def _note_sent(self, entry: Entry, start: int) -> None:
        _, port, _, offered, frame, _, _ = entry
        wait = start - offered
        self.sent += 1
        self._queued[port] -= 1
        if self._behind[port]:
            heapq.heappush(self._waiting, self._behind[port].popleft())
        key = (frame[0], frame[4])  # identifier, extended: by index, twice as fast
        traffic = self._traffic.get(key)
        if traffic is None:
            traffic = self._traffic[key] = Traffic()
        traffic.note_sent(wait)

    def _deliver(self, delivery: Delivery, delivered: list[Delivery]) -> None:
        if self._impairment.clean:
            delivered.append(delivery)
        elif not self._line.send(delivery.time, delivery):
            self.lost += 1
            self._traffic_of(delivery.frame).lost += 1
        elif self._line.next_ns <= delivery.time:
            delivered += self._arrived(delivery.time)

    def _arrived(self, now_ns: int) -> list[Delivery]:
        """The impaired deliveries that are due."""
        return [delivery._replace(time=at) for at, delivery in self._line.pop_due(now_ns)]

    # --- attempts that may fail ---------------------------------------------------------------------------------

    def _attempt(self, now_ns: int, draw: bool, damaged: int | None) -> None:
        """Start whatever is ready, and let ``bus.nodes`` tell what comes of it."""
        nodes = self._nodes
        entries: dict[int, Entry] = {}
        for entry in sorted(self._waiting):
            if entry[1] not in entries:
                ready = nodes.can_send_from(entry[1])
                if ready is not None and ready <= now_ns:
                    entries[entry[1]] = entry
        if not entries:
            return
        winner, best = next(iter(entries.items()))
        alone = all(entry[0] != best[0] or entry is best for entry in entries.values())
        if not alone:
            self.collisions += 1
        heads = {port: nodes.as_sent(port, entry[4]) for port, entry in entries.items()}
        if draw and not self._impairment.clean:
            damaged = self._impairment.damaged_at(best[5] + best[6] + TAIL - INTERMISSION)
        flips = {} if damaged is None else {port: {damaged} for port in range(self.ports)}
        if self._armed:
            self._take_damage(heads[winner], flips)
        nodes.interrupted(self._free_at - self._integration_ns, now_ns)
        self._follow(now_ns, entries, nodes.attempt(now_ns, heads, winner, alone, flips))

    def _take_damage(self, frame: Frame, flips: dict[int, set[int]]) -> None:
        """Add the damage that is due in this attempt to ``flips``."""
        key = (frame.id, frame.extended)
        left = []
        for occurrence, bit, port in self._armed.pop(key, []):
            place = encode(frame).place(bit)
            if occurrence > 1:
                left.append((occurrence - 1, bit, port))
            elif place is not None:
                for one in range(self.ports) if port is None else (port,):
                    flips.setdefault(one, set()).add(place)
        if left:
            self._armed[key] = left

    def _follow(self, start: int, entries: dict[int, Entry], outcome: Outcome) -> None:
        self._sending = (outcome.ends, start, None, (entries, outcome))
        self._free_at = outcome.idle
        self.busy_ns += outcome.idle - start
        self._foretold = sorted([*self._foretold, *outcome.events])

    def _conclude(self, now_ns: int, sending: Sending, delivered: list[Delivery]) -> None:
        assert sending[3] is not None
        entries, outcome = sending[3]
        self._nodes.apply(outcome)
        self.errors += outcome.error
        for port, entry in entries.items():
            if port in outcome.sent:
                self._remove(entry)
                self._note_sent(entry, sending[1])
            elif port in self._nodes.one_shot or entry[2] in self._withdrawn:
                self._remove(entry)
                self._give_up(entry)
            elif port in outcome.failed:
                self._traffic_of(entry[4]).retransmitted += 1
            self._withdrawn.discard(entry[2])
        if outcome.frame is not None:
            self._deliver(Delivery(now_ns, outcome.sender, outcome.frame, outcome.missed), delivered)
        if outcome.jammed:
            self._jammed_since, self._free_at = outcome.idle, NEVER

    def _remove(self, entry: Entry) -> None:
        self._waiting.remove(entry)
        heapq.heapify(self._waiting)

    def _give_up(self, entry: Entry) -> None:
        port = entry[1]
        self.dropped += 1
        self._given_up.append((port, entry[4]))
        self._traffic_of(entry[4]).lost += 1
        self._queued[port] -= 1
        if self._behind[port]:
            heapq.heappush(self._waiting, self._behind[port].popleft())

    def _wake(self, now_ns: int) -> None:
        """Nodes that come back from bus off, and a wire that becomes dominant."""
        self.told.extend(self._nodes.recover(self._free_at - self._integration_ns, now_ns))
        if self._nodes.dominant:
            self._nodes.interrupted(self._free_at - self._integration_ns, now_ns)
            self._follow(now_ns, {}, self._nodes.jam(now_ns, {}, now_ns))

    def _next_with_faults(self) -> int:
        nodes, free_at = self._nodes, self._free_at
        if free_at == NEVER or nodes.dominant:
            return free_at
        ready = [nodes.can_send_from(port) for port in {entry[1] for entry in self._waiting}]
        times = [max(free_at, time) for time in ready if time is not None]
        recovery = nodes.recovery_at(free_at - self._integration_ns)
        return min([*times, NEVER if recovery is None else max(free_at, recovery)])

    # --- what there is to know, and impairments -----------------------------------------------------------------

    @property
    def counts(self) -> dict[str, int]:
        """What has happened to the frames so far."""
        line = self._line
        return {
            "sent": self.sent, "lost": self.lost, "errors": self.errors, "refused": self.refused,
            "duplicated": line.duplicated, "corrupted": line.corrupted, "reordered": line.reordered,
        }  # fmt: skip

    def set(self, key: str, value: Any) -> None:
        """Change one impairment from the next frame on."""
        self._impairment.set(key, value)

    def ports_state(self, port: int) -> PortState:
        """Error counters and state of a node, as of the last frame's end."""
        one = self._nodes.counters[port]
        return PortState(one.tec, one.rec, one.state)

    def error_frames(self) -> list[Event]:
        """(time in ns, port, error frame) of what the nodes' controllers have told since the last call, in order. The
        oldest are forgotten when nobody asks."""
        if not self.told:
            return []
        events = list(self.told)
        self.told.clear()
        return events

    def given_up(self) -> list[tuple[int, Frame]]:
        """(port, frame) of what has left a transmit queue unsent since the last call, in order. The oldest are
        forgotten when nobody asks."""
        frames = list(self._given_up)
        self._given_up.clear()
        return frames

    def waiting(self, port: int) -> int:
        """How many frames of ``port`` wait in its transmit queue."""
        return self._queued[port]

    def waits(self) -> dict[tuple[int, bool], Wait]:
        """By (identifier, extended): how long frames waited until the attempt that succeeded."""
        return {key: one.wait for key, one in sorted(self._traffic.items()) if one.sent}

    def traffic(self) -> dict[tuple[int, bool], Traffic]:
        """By (identifier, extended): counts and waiting times."""
        return dict(sorted(self._traffic.items()))

    def _traffic_of(self, frame: Frame) -> Traffic:
        return self._traffic.setdefault((frame.id, frame.extended), Traffic())

    # --- state --------------------------------------------------------------------------------------------------

    _PLAIN = (
        "_order", "_free_at", "_sending", "_jammed_since", "busy_ns", "sent", "lost", "errors", "refused", "dropped",
        "collisions", "next_ns",
    )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in self._PLAIN},
            "waiting": list(self._waiting),
            "behind": [list(queue) for queue in self._behind],
            "queued": list(self._queued),
            "line": self._line.snapshot(),
            "foretold": list(self._foretold),
            "error_frames": list(self.told),
            "armed": {key: list(items) for key, items in self._armed.items()},
            "withdrawn": set(self._withdrawn),
            "given_up": list(self._given_up),
            "traffic": {key: one.snapshot() for key, one in self._traffic.items()},
            "nodes": self._nodes.snapshot(),
            "impairment": self._impairment.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in self._PLAIN:
            setattr(self, name, state[name])
        self._waiting = list(state["waiting"])
        self._behind = [deque(queue) for queue in state["behind"]]
        self._queued = list(state["queued"])
        self._line.restore(state["line"])
        self._foretold = list(state["foretold"])
        self.told = deque(state["error_frames"], maxlen=_UNREAD)
        self._armed = {key: list(items) for key, items in state["armed"].items()}
        self._withdrawn = set(state["withdrawn"])
        self._given_up = deque(state["given_up"], maxlen=_UNREAD)
        self._traffic = {key: Traffic.restored(saved) for key, saved in state["traffic"].items()}
        self._nodes.restore(state["nodes"])
        self._impairment.restore(state["impairment"])
