"""Configuration of buses and links, and of everything that can be made wrong about them.

The fields of ``Impairment``, ``Babble``, ``Background`` and ``NodeFaults`` can also be injected while a run goes on:
their descriptions, units, bounds and defaults are what ``hil inject --list`` shows.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from robots.quantities import BitRate, Config, FrameRate, PartsPerMillion, Probability, Seconds


def _whole(value: Any) -> Any:
    """Whole numbers may be written as on a command line: "64", "0x181"."""
    try:
        return int(value, 0) if isinstance(value, str) else value
    except ValueError:
        return value


Identifier = Annotated[int, BeforeValidator(_whole), Field(ge=0, le=0x7FF)]
FrameLength = Annotated[
    Literal[0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], BeforeValidator(_whole)
]  # what a CAN FD frame can carry
# identifier, bit (from SOF with stuff bits, or FIELD:NUMBER without), which attempt to send it from now on
_DAMAGE = re.compile(r"(0x[0-9a-fA-F]{1,8}|\d{1,9}) (\d{1,4}|[a-z_]{1,20}(:\d{1,4})?)( [1-9]\d{0,5})?")


def _damage(value: str) -> str:
    if value and _DAMAGE.fullmatch(value) is None:
        raise ValueError('expected "IDENTIFIER BIT" or "IDENTIFIER BIT ATTEMPT", for example "0x182 crc:3"')
    return value


Damage = Annotated[str, AfterValidator(_damage)]
Share = Annotated[float, Field(ge=0, le=0.99)]


class Burst(Config):
    """Losses in bursts (Gilbert 1960, Elliott 1963): a Markov chain of two states that steps at every delivery.

    Bursts last 1/leave deliveries in the mean; enter / (enter + leave) of all deliveries fall into one.
    """

    enter: Probability = Field(default=0.0, description="probability per delivery that a burst begins; 0: none")
    leave: Probability = Field(default=0.2, description="probability per delivery that a burst ends; it lasts 1/leave")
    loss: Probability = Field(default=1.0, description="share of the deliveries within a burst that vanish")


class Impairment(Config):
    """What a link does to what it carries. The same faults for a CAN bus and for a Zenoh link."""

    delay: Seconds = Field(default=0.0, description="added to every delivery")
    jitter: Seconds = Field(default=0.0, description="added on top at random; later deliveries may overtake")
    jitter_shape: Literal["uniform", "normal", "exponential", "lognormal", "pareto"] = Field(
        default="uniform",
        description="uniform in [0, jitter]; normal: half a normal, sigma = jitter; exponential, lognormal (sigma of "
        "the logarithm 1) and pareto (tail x^-3) have the mean jitter",
    )
    loss: Probability = Field(default=0.0, description="share of deliveries that vanish")
    burst: Burst = Burst()
    bit_error_rate: Probability = Field(
        default=0.0, description="per bit, and noticed: CAN retransmits the frame, a link discards the sample"
    )
    corruption: Probability = Field(default=0.0, description="share of deliveries with a bit flipped unnoticed")
    duplicate: Probability = Field(default=0.0, description="share of deliveries that arrive twice")
    reorder: Probability = Field(default=0.0, description="share of deliveries overtaken by the next")


class Babble(Config):
    """A babbling idiot: a node that sends one identifier over and over, whether anybody wants it or not.

    Beyond the rate that the bus can carry it sends back to back: then nothing of a lower priority gets through.
    """

    rate: FrameRate = Field(default=0.0, description="per second; 0: silent; more than the bus can carry: back to back")
    identifier: Identifier = Field(default=0x001, description="the lower, the more it starves")
    length: FrameLength = Field(default=8, description="bytes")


class Background(Config):
    """Other nodes' traffic: frames of a range of identifiers, CAN FD with bit-rate switch, with random content."""

    load: Share = Field(default=0.0, description="share of the bus's time that it asks for; 0: none")
    pattern: Literal["periodic", "poisson"] = Field(
        default="periodic", description="evenly spaced, identifiers in turn; or at random times, identifiers at random"
    )
    identifier: Identifier = Field(default=0x101, description="the first; below 0x181 they go before drives' states")
    identifiers: Annotated[int, BeforeValidator(_whole), Field(ge=1, le=128)] = Field(
        default=16, description="how many"
    )
    length: FrameLength = Field(default=8, description="bytes")


class NodeFaults(Config):
    """What is wrong with one node of a bus."""

    cut: bool = Field(default=False, description="its cable is cut: it neither sends, receives nor acknowledges")
    stuck_dominant: bool = Field(default=False, description="its transceiver holds the bus dominant; nothing passes")
    listen_only: bool = Field(default=False, description="it receives, and sends nothing, not even an acknowledgement")
    one_shot: bool = Field(default=False, description="it gives a frame up that lost arbitration or failed")
    restart: bool = Field(default=False, description="true: it is asked to come back from bus off")
    bit_rate: Annotated[float, Field(ge=0.5, le=2)] = Field(default=1.0, description="its bit rates over the bus's")
    node_id: Annotated[int, BeforeValidator(_whole), Field(ge=0, le=127)] = Field(
        default=0, description="it sends with the identifiers of this node, as if set up wrongly; 0: its own"
    )
    drift: PartsPerMillion = Field(default=0.0, description="its clock is fast, or slow when negative")


class BusConfig(Impairment):
    """A CAN FD bus: its two bit rates, its impairments, unwanted traffic, and faults of its nodes by name.

    ``damage`` and a node's ``restart`` happen once, whenever they are set.
    """

    arbitration_rate: BitRate = 1e6
    data_rate: BitRate = 5e6
    # Which of a node's frames is next: that of the highest priority (mailboxes), or the oldest (a FIFO, which shows
    # priority inversion).
    queue: Literal["priority", "fifo"] = "priority"
    # After bus off: recover by itself, or only on request (as SocketCAN's restart-ms 0).
    bus_off_recovery: Literal["automatic", "request"] = "automatic"
    damage: Damage = Field(
        default="", description='one bit of the next frame of an identifier: "0x182 crc:3"; of its fifth: "0x182 17 5"'
    )
    babble: Babble = Babble()
    background: Background = Background()
    node: dict[str, NodeFaults] = Field(default_factory=dict)


class MotionCaptureLink(Impairment):
    """From the motion capture system, whose cameras and computers take about 5 ms (Kim 2018 §7.2.1)."""

    delay: Seconds = Field(default=5e-3, description="from the exposure to the delivery")


class LinkConfig(Config):
    """The Zenoh link between gateway and central controller, one set of impairments per direction, and what the motion
    capture system sends to the controller."""

    state: Impairment = Impairment()  # joints and IMU to controller
    command: Impairment = Impairment()  # controller to joints
    motion_capture: MotionCaptureLink = MotionCaptureLink()
