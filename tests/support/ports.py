"""Ports of a bus whose server is looked after by the test itself: no thread, no clock."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import can
from hypothesis import strategies as st

from bus.frames import CAN_FD_LENGTHS, Frame
from bus.ports import PortServer
from bus.python_can import HilBus

RUN = f"test-{os.getpid()}"
CHANNEL = f"{RUN}/left_leg"


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended, fd = draw(st.booleans()), draw(st.booleans())
    length = draw(st.sampled_from(CAN_FD_LENGTHS if fd else range(9)))
    data = draw(st.binary(min_size=length, max_size=length))
    return Frame(
        draw(st.integers(0, 2 ** (29 if extended else 11) - 1)),
        bytes(length) if (remote := not fd and draw(st.booleans())) else data,
        fd,
        fd and draw(st.booleans()),
        extended,
        remote,
        fd and draw(st.booleans()),
    )


def message(identifier: int = 0x10, **options: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, **options)


class attached:
    """A bus that attaches while the server polls: its greeting comes with the poll."""

    def __init__(self, server: PortServer, channel: str = CHANNEL, **options: object) -> None:
        self.server, self.channel, self.options = server, channel, options

    def __enter__(self) -> HilBus:
        with ThreadPoolExecutor(1) as pool:
            opening = pool.submit(lambda: HilBus(self.channel, **self.options))  # type: ignore[arg-type]
            while not opening.done():  # whoever else knocks meanwhile
                self.server.poll()
            self.bus = opening.result()
        return self.bus

    def __exit__(self, *_: object) -> None:
        self.bus.shutdown()
