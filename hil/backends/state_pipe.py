"""Pipes on which the launcher asks a node's process for its state, or gives it one back: rare, so pickled."""

from __future__ import annotations

import socket
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from hil.backends.lifecycle import Family
from hil.errors import EmulationError


def connections() -> tuple[Connection, Connection]:
    """Both ends of a new pipe."""
    ours, theirs = socket.socketpair()
    return Connection(ours.detach()), Connection(theirs.detach())


def receive(family: Family, pipe: Connection) -> Any:
    """Receive from a child. Raises EmulationError when it, or another one, has died."""
    while not pipe.poll(0.2):
        family.check()
    try:
        return pipe.recv()
    except EOFError:
        family.check()
        raise EmulationError("a process of the run closed its pipe") from None


def serve_pipe(node: Any, pipe: Connection, **questions: Callable[[], Any]) -> None:
    """Answer one request: for a node's state, for its replacement, or one of ``questions``."""
    what, state = pipe.recv()
    if what in questions:
        pipe.send(questions[what]())
    else:
        pipe.send(node.snapshot() if what == "snapshot" else node.restore(state))
