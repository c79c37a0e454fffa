"""Tools on the buses of a run: what they hear of errors, and what the record keeps of them."""

import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import can

from bus.frames import ErrorFrame
from hil.control import serve_run
from hil.run import Request, assemble
from hil.scenario import load

_MS = 1_000_000


def test_an_error_on_a_bus_is_recorded_and_told_as_the_tools_controller_has_it(tmp_path: Path) -> None:
    out = tmp_path / f"tap-{uuid.uuid4().hex[:8]}"
    error = ErrorFrame(0x88, bytes.fromhex("0000040800000809"))
    request = Request(load("stand", ["duration=0.1s"]), backend="inline", out=out, log_formats=("pcap",))
    with assemble(request) as assembly:
        serve_run(assembly)
        system = assembly.system
        names = [wire.name for wire in system.wires]
        left, tools = names.index("left_leg"), system.wires[0].ports - 1
        with ThreadPoolExecutor(1) as pool:
            opening = pool.submit(can.Bus, interface="hil", channel=f"{out.name}/left_leg")
            while not opening.done():
                system.tap.poll()
        with opening.result() as bus:
            system.run_until(25 * _MS)  # the drives have booted
            system._note_error(left, 25 * _MS + 1, 1, ErrorFrame(0x4, bytes(8)))  # of a joint's controller
            system._note_error(left, 25 * _MS + 2, tools, error)
            system.run_until(30 * _MS)
            heard = []
            while (message := bus.recv(0)) is not None:
                heard.append(message)
    errors = [m for m in heard if m.is_error_frame]
    assert [(m.arbitration_id, bytes(m.data), round(m.timestamp * 1e9)) for m in errors] == [(*error, 25 * _MS + 2)]
    assert len(heard) > 30
    lines = [line for line in (out / "left_leg.log").read_text().splitlines() if " 2000" in line]
    assert lines == ["(0.025000002) left_leg 20000088#0000040800000809"]
    assert bytes.fromhex("20000088 08000000 0000040800000809") in (out / "left_leg.pcap").read_bytes()


def test_a_tool_is_heard_at_the_next_tick_of_the_controller(tmp_path: Path) -> None:
    """Its frame arbitrates with the others of that instant, on the tools' own port."""
    out = tmp_path / f"tap-{uuid.uuid4().hex[:8]}"
    with assemble(Request(load("stand", ["duration=0.1s"]), backend="inline", out=out)) as assembly:
        serve_run(assembly)
        system = assembly.system
        with ThreadPoolExecutor(1) as pool:
            opening = pool.submit(can.Bus, interface="hil", channel=f"{out.name}/right_leg")
            while not opening.done():
                system.tap.poll()
        with opening.result() as bus:
            system.run_until(5 * _MS)
            sent = bus.transmit(can.Message(arbitration_id=0x7F0, is_extended_id=False, data=b"\x01"))
            system.run_until(7 * _MS)
            at_ns = round(sent.result(1.0) * 1e9)
        assert system.tap.frames_in == 1
    assert 5 * _MS < at_ns < 6 * _MS
    line = next(line for line in (out / "right_leg.log").read_text().splitlines() if " 7F0#" in line)
    assert line == f"(0.{at_ns:09d}) right_leg 7F0#01"
