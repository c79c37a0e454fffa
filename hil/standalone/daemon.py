"""A process that outlives the command which starts it: detached from terminal, session and descriptors."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from hil.errors import EmulationError, HilError, UserError

Ready = Callable[[dict[str, Any]], None]


def state_directory() -> Path:
    """Where this user's programs keep what outlives them (XDG Base Directory Specification)."""
    root = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    try:
        return Path(root).expanduser() / "hume-hil"
    except RuntimeError:
        raise UserError("there is no home directory: set XDG_STATE_HOME, or name a directory with --log") from None


def detach(main: Callable[[Ready], None], messages: Path) -> dict[str, Any]:
    """Run ``main`` in a process of its own and return what it passes to its argument, as soon as it does.

    What it prints goes to ``messages``. Raises what it raises before, UserError or EmulationError.
    """
    try:
        messages.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        output = os.open(messages, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UserError(f"{messages}: cannot be written ({error.strerror})") from None
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        if os.fork():
            os._exit(0)  # the grandchild leads no session: it can never get a terminal
        _daemon(main, output, write)
    os.close(write)
    os.close(output)
    os.waitpid(child, 0)
    with open(read, "rb") as pipe:
        text = pipe.read()
    try:
        answer = json.loads(text)
    except ValueError:
        raise EmulationError(f"it ended while it started; {messages} may say why") from None
    if "error" in answer:
        raise (UserError if answer["status"] == UserError.exit_status else EmulationError)(answer["error"])
    return answer


def _daemon(main: Callable[[Ready], None], output: int, report: int) -> NoReturn:
    """The rest of the grandchild's life."""
    status = 3
    try:
        null = os.open(os.devnull, os.O_RDONLY)
        for descriptor, standard in ((null, 0), (output, 1), (output, 2)):
            os.dup2(descriptor, standard)
        os.dup2(report, 3)
        os.closerange(4, os.sysconf("SC_OPEN_MAX"))  # locks and pipes of whoever started it
        os.set_inheritable(3, False)
        os.chdir("/")
        signal.signal(signal.SIGINT, signal.SIG_DFL)

        def ready(about: dict[str, Any]) -> None:
            os.write(3, json.dumps(about).encode())
            os.close(3)

        try:
            main(ready)
            status = 0
        except HilError as error:
            print(f"hil: {error}", flush=True)
            status = error.exit_status
            with contextlib.suppress(OSError):
                os.write(3, json.dumps({"error": str(error), "status": status}).encode())
        except BaseException:
            import traceback

            traceback.print_exc()
    finally:
        os._exit(status)
