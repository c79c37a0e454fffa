"""Stand-alone buses seen from outside: which there are, what they have done, and their end."""

from __future__ import annotations

import os
import select
import signal
from typing import Any

from bus.port_client import peer
from bus.ports import PortError, connect, find_runs, served
from bus.zenoh_link import keys
from hil import control
from hil.errors import EmulationError, UserError
from hil.injection import Injectable, of_standalone_bus
from hil.schema import nearest
from hil.standalone.faults import unknown

_GONE_AFTER_S = 10.0


def buses() -> dict[str, dict[str, Any]]:
    """What every stand-alone bus of this user tells of itself, by name."""
    return {name: hello for name, hello in find_runs().items() if "data_rate" in hello}


def find(name: str) -> dict[str, Any]:
    """What the bus ``name`` tells of itself. Raises UserError when there is none, with the nearest name."""
    there = buses()
    if name in there:
        return there[name]
    if any(run == name for run, _ in served()) and name not in there:
        raise UserError(f"{name!r} is a run, not a stand-alone bus (or does not answer at the moment)")
    hint = nearest(name, sorted(there)) or "; none is up (`hil bus up NAME` starts one)"
    raise UserError(f"no bus {name!r}{hint}")


def status(name: str) -> dict[str, Any]:
    """The status of the bus ``name``, see ``StandaloneBus.status``."""
    return control.ask(name, find(name)["endpoint"], keys(name).status)


def injectable(key: str) -> dict[str, Injectable]:
    """All that can be injected into the stand-alone bus that ``key`` is of, with the clients that it has; empty when it
    is of none. Raises UserError for a client that it has not."""
    name = next((name for name in buses() if f"{key}.".startswith(f"bus.{name}.")), None)
    if name is None:
        return {}
    clients = status(name)["clients"]
    known = of_standalone_bus(name, [client["node"] for client in clients])
    node = f"bus.{name}.node."
    if key.startswith(node) and not any(f"{one}.".startswith(f"{key}.") for one in known):
        raise UserError(f"{key}: {unknown(name, key, clients)}")
    return known


def down(name: str) -> int:
    """End the bus ``name`` and return when its process has gone; returns its process id.

    Raises UserError when there is none, EmulationError when it does not end.
    """
    find(name)
    try:
        connection, _ = connect(f"{name}/{name}", ask_only=True)
    except PortError as error:
        raise UserError(str(error)) from None
    pid = peer(connection)[0]  # of the process that serves the name, from the kernel
    connection.close()
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return pid
    try:
        signal.pidfd_send_signal(process, signal.SIGTERM)
        if not select.select([process], [], [], _GONE_AFTER_S)[0]:
            raise EmulationError(f"bus {name!r} (process {pid}) does not end: kill -9 {pid}")
    except ProcessLookupError:
        pass
    finally:
        os.close(process)
    return pid
