"""Configuration of buses and links."""

from __future__ import annotations

from typing import Literal

from robots.quantities import BitRate, Config, Probability, Seconds


class Impairment(Config):
    """What a link does to what it carries. The same four faults for a CAN bus and for a Zenoh link."""

    delay: Seconds = 0.0  # added to every delivery
    jitter: Seconds = 0.0  # added on top, uniform in [0, jitter]
    loss: Probability = 0.0  # share of deliveries that vanish
    bit_error_rate: Probability = 0.0  # per bit; CAN retransmits the frame, a link discards the sample


class BusConfig(Impairment):
    """A CAN FD bus: its two bit rates, how its controllers behave, and its impairments."""

    arbitration_rate: BitRate = 1e6
    data_rate: BitRate = 5e6
    # Which of a node's frames is next: that of the highest priority (mailboxes), or the oldest (a FIFO, which shows
    # priority inversion).
    queue: Literal["priority", "fifo"] = "priority"
    # After bus off: recover by itself, or only on request (as SocketCAN's restart-ms 0).
    bus_off_recovery: Literal["automatic", "request"] = "automatic"


class LinkConfig(Config):
    """The Zenoh link between gateway and central controller, one set of impairments per direction."""

    state: Impairment = Impairment()  # joints and IMU to controller
    command: Impairment = Impairment()  # controller to joints
