"""What can be made wrong about a stand-alone bus while it is up: by key, on its wire and with its clients."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from bus.config import BusConfig
from bus.link import NEVER
from bus.talkers import Talker
from bus.wire import Wire
from hil.errors import UserError
from hil.faults import NodeSetter, set_wire
from hil.injection import OF_JOINTS, OTHERS, of_bus, of_standalone_bus
from hil.scenario import parse_value
from hil.schema import nearest
from hil.standalone.clients import PortClient


def unknown(name: str, key: str, clients: Iterable[Mapping[str, Any]]) -> str:
    """Why the bus ``name`` with ``clients`` (their summaries) does not take ``key``; a part of a sentence."""
    there = {client["node"]: f"{client['node']} ({client['process']}, {client['pid']})" for client in clients}
    node, _, fault = key.removeprefix(f"bus.{name}.node.").partition(".")
    if not key.startswith(f"bus.{name}.node."):
        return f"no such key{nearest(key, list(of_standalone_bus(name, list(there))))}"
    if node not in there and node != OTHERS:
        return f"no client {node!r}; " + (f"attached: {', '.join(there.values())}" if there else "none is attached")
    if node == OTHERS:
        return f"the nodes that are no clients can only be cut (bus.{name}.node.{OTHERS}.cut)"
    if node in there and fault in OF_JOINTS:
        return f"{fault} is a fault of the joints of a run; a client's clock and node id are its own"
    return f"no such key{nearest(key, list(of_standalone_bus(name, list(there))))}"


class ClientFaults:
    """Sets what is injected into the bus ``name``, and keeps the faults of each client and of the nodes that are none.

    A fault of a client belongs to its plug: the next one at its port is sound.

    others: ports that no client has. They stand for other nodes, which acknowledge unless they are cut.
    talkers: by key, with their ports; one that is silent is one of the others. config: what is wrong from the start.
    """

    def __init__(
        self,
        name: str,
        wire: Wire,
        talkers: Mapping[str, tuple[Talker, int]],
        others: Sequence[int],
        config: BusConfig,
    ) -> None:
        self._name, self._wire, self._talkers = name, wire, talkers
        self._others = set(others)
        self._cut = OTHERS in config.node and config.node[OTHERS].cut
        self._connect_others(0)
        set_wire(wire, "damage", config.damage, 0)

    def known(self, clients: Iterable[PortClient]) -> list[str]:
        """The keys that can be set with these clients."""
        return list(of_standalone_bus(self._name, [client.node for client in clients]))

    def set(self, key: str, value: str | float, clients: Iterable[PortClient], now_ns: int) -> tuple[Any, Any]:
        """Change one value from now on. Returns it in SI units, and the client that it belongs to, if any.

        Raises UserError for a wrong key or value.
        """
        clients = list(clients)
        known = self.known(clients)
        if key not in known:
            if not key.startswith(f"bus.{self._name}.node."):
                raise UserError(f"unknown key {key!r}{nearest(key, known)} (`hil inject --list bus.{self._name}`)")
            raise UserError(f"{key}: {unknown(self._name, key, [client.summary() for client in clients])}")
        parsed = parse_value(key, value)
        path = key.removeprefix(f"bus.{self._name}.")
        part, _, rest = path.partition(".")
        client = None
        try:
            if part in self._talkers:
                self._talkers[part][0].set(rest, parsed, now_ns)
                self._connect_others(now_ns)
            elif part != "node":
                set_wire(self._wire, path, parsed, now_ns)
            elif rest == f"{OTHERS}.cut":
                self._cut = bool(parsed)
                self._connect_others(now_ns)
            else:
                node, _, fault = rest.partition(".")
                client = next(client for client in clients if client.node == node)
                NodeSetter(self._wire, client.port, None, None)(fault, parsed, now_ns)
                self._note(client, fault, parsed, of_bus(self._name, (node,))[key].default)
        except (KeyError, ValueError) as error:
            raise UserError(f"{key} = {value}: nothing to inject ({error})") from None
        return parsed, client

    @staticmethod
    def _note(client: PortClient, fault: str, value: Any, default: Any) -> None:
        client.faults.pop(fault, None)
        if value != default and fault != "restart":  # that happens once
            client.faults[fault] = value

    # --- who is there ---------------------------------------------------------------------------------------------

    def plug(self, port: int, now_ns: int) -> None:
        """A client has come to ``port``."""
        self._others.discard(port)
        self._wire.cut(port, False, now_ns)

    def unplug(self, port: int, now_ns: int) -> bool:
        """The client at ``port`` has left. False while a frame of its is under way: to be called again."""
        if not self._wire.unplug(port, now_ns):
            return False
        self._others.add(port)
        self._wire.cut(port, self._cut, now_ns)
        return True

    def _connect_others(self, now_ns: int) -> None:
        for port in self._others:
            self._wire.cut(port, self._cut, now_ns)
        for talker, port in self._talkers.values():
            self._wire.cut(port, self._cut and talker.next_ns == NEVER, now_ns)
