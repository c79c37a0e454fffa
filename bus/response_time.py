"""The longest response times on a CAN bus, from its message set alone.

The analysis of Davis, Burns, Bril and Lukkien, "Controller Area Network (CAN) schedulability analysis: Refuted,
revisited and revised", Real-Time Systems 35 (2007) 239–272. Fixed priorities, no pre-emption, queues that offer
their most urgent frame first. A message m is queued at most J_m after the event that causes it, events are at
least T_m apart, and its frame occupies the bus for C_m, intermission included. With the blocking B_m, the longest
frame of lower priority, every instance q of the priority-m busy period t_m is looked at::

    t_m    = B_m + Σ_{k ∈ hp(m) ∪ {m}} ⌈(t_m + J_k) / T_k⌉ C_k + E_m(t_m)
    w_m(q) = B_m + q C_m + Σ_{k ∈ hp(m)} ⌈(w_m(q) + J_k + τ) / T_k⌉ C_k + E_m(w_m(q) + C_m)
    R_m    = max_{q < ⌈(t_m + J_m) / T_m⌉}  J_m + w_m(q) − q T_m + C_m

τ is the time within which two frames still take part in the same arbitration: one bit on a real bus, and never
less than the resolution of time. E_m(t) is what faults cost within t: at most one fault per T_f, each costing an
error frame of 31 bits and the repetition of the longest frame that is not of lower priority::

    E_m(t) = ⌈t / T_f⌉ (31 τ + max_{k ∈ hp(m) ∪ {m}} C_k)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from bus.frames import Frame
from bus.timing import INTERMISSION, TAIL, BitRates, frame_bits

ERROR_FRAME_BITS = 31  # flag 6, echo 6, delimiter 8, intermission 3, suspended transmission 8
LONGEST_NS = 60 * 10**9  # a busy period beyond this counts as unbounded


@dataclass(frozen=True)
class Message:
    """A periodic or sporadic message. All times in ns.

    order: place in the arbitration, lower wins. frame: longest time its frame occupies the bus, intermission
    included. period: least time between two of its events. jitter: longest time from event to queueing.
    deadline: from the event; None: the period.
    """

    name: str
    order: int
    frame: int
    period: int
    jitter: int = 0
    deadline: int | None = None


@dataclass(frozen=True)
class Response:
    """What the analysis says of one message. All times in ns.

    longest: from its event until its frame has ended, intermission included; None: no bound. from_queue: the same from
    being queued, what a bus can observe. instances: of the message within its longest busy period.
    """

    message: Message
    blocking: int
    longest: int | None = None
    from_queue: int | None = None
    instances: int = 0

    @property
    def deadline(self) -> int:
        return self.message.period if self.message.deadline is None else self.message.deadline

    @property
    def slack(self) -> int | None:
        """What is left of the deadline; negative when it can be missed."""
        return None if self.longest is None else self.deadline - self.longest

    @property
    def schedulable(self) -> bool:
        return self.longest is not None and self.longest <= self.deadline


def utilisation(messages: Sequence[Message]) -> float:
    """Share of the bus that ``messages`` take when every frame is as long as it can be."""
    return sum(m.frame / m.period for m in messages)


def response_times(messages: Sequence[Message], bit_ns: int, fault_interval: int | None = None) -> list[Response]:
    """The longest response time of each of ``messages``, by priority.

    Args:
        messages: all messages of the bus. Those of equal order interfere with each other.
        bit_ns: τ, a bit time in ns; 1 for a wire that resolves nanoseconds.
        fault_interval: least time between two faults, ns; None: there are none.
    """
    ranked = sorted(messages, key=lambda m: m.order)
    return [_response(m, ranked, bit_ns, fault_interval) for m in ranked]


def _response(m: Message, ranked: Sequence[Message], bit_ns: int, fault_interval: int | None) -> Response:
    higher = [k for k in ranked if k.order <= m.order and k is not m]
    blocking = max((k.frame for k in ranked if k.order > m.order), default=0)
    recovery = ERROR_FRAME_BITS * bit_ns + max(k.frame for k in (*higher, m))
    no_bound = Response(m, blocking)

    def faults(span: int) -> int:
        return 0 if fault_interval is None else -(-span // fault_interval) * recovery

    growth = utilisation([*higher, m]) + (recovery / fault_interval if fault_interval else 0.0)
    if growth > 1 or (growth == 1 and blocking):
        return no_bound
    busy, before = blocking + m.frame, 0
    while busy != before:
        if busy > LONGEST_NS:
            return no_bound
        before = busy
        busy = blocking + faults(before)
        busy += sum(-(-(before + k.jitter) // k.period) * k.frame for k in (*higher, m))
    instances = -(-(busy + m.jitter) // m.period)
    longest = from_queue = 0
    for q in range(instances):
        own = blocking + q * m.frame
        wait, before = own, -1
        while wait != before:
            before = wait
            wait = own + faults(before + m.frame)
            wait += sum(-(-(before + k.jitter + bit_ns) // k.period) * k.frame for k in higher)
        end = wait + m.frame
        longest = max(longest, m.jitter + end - q * m.period)
        from_queue = max(from_queue, end - max(q * m.period - m.jitter, 0))
    return Response(m, blocking, longest, from_queue, instances)


# --- the longest frames ---------------------------------------------------------------------------------------


def _longest_runs(bits: int) -> list[int]:
    """Contents of ``bits`` bits with the most stuff bits, one for each state of the sender after the length code.

    Repeating the last bit sent, stuff bits included, stuffs after every fourth bit, and nothing does more; which
    bits these are depends on the value and the length of the run that the header ends in.
    """
    contents = []
    for last in (0, 1):
        for run in range(1, 6):
            value, bit, length = 0, last, run
            for _ in range(bits):
                if length == 5:
                    bit, length = 1 - bit, 1
                value, length = value << 1 | bit, length + 1
            contents.append(value)
    return contents


@lru_cache(maxsize=4096)
def longest_frame(identifier: int, length: int, brs: bool = True, extended: bool = False) -> Frame:
    """A CAN FD frame than which none of this identifier and length is longer, whatever its content.

    Raises InvalidFrameError for a frame that no controller could send.
    """
    contents = [value.to_bytes(length, "big") for value in _longest_runs(8 * length)]
    frames = [Frame(identifier, data, True, brs, extended, esi=esi) for data in contents for esi in (False, True)]
    return max(frames, key=lambda frame: sum(frame_bits(frame)))


@lru_cache(maxsize=4096)
def longest_frame_bits(
    identifier: int, length: int, fd: bool = True, brs: bool = True, extended: bool = False
) -> tuple[int, int]:
    """Most bits of a frame of this identifier and length for any content, intermission included: at the arbitration
    rate and at the data rate.

    Exact for CAN FD, whose checksum has fixed stuff bits. A classical frame's checksum depends on its content; its
    bound is Davis et al. 2007, (1): every fourth bit behind the first is stuffed.

    Raises InvalidFrameError for a frame that no controller could send.
    """
    if fd:
        slow, fast = frame_bits(longest_frame(identifier, length, brs, extended))
        return slow + TAIL, fast
    frame_bits(Frame(identifier, bytes(length), fd, brs, extended))  # is there such a frame?
    stuffed = (54 if extended else 34) + 8 * length
    return stuffed + (stuffed - 1) // 4 + 1 + TAIL, 0


def longest_frame_ns(
    identifier: int, length: int, rates: BitRates, fd: bool = True, brs: bool = True, extended: bool = False
) -> int:
    """Longest time a frame of this identifier and length occupies the bus, intermission included, ns; frame and
    intermission each rounded up, as the wire does."""
    slow, fast = longest_frame_bits(identifier, length, fd, brs, extended)
    return rates.ns(slow - INTERMISSION, fast) + rates.ns(INTERMISSION)
