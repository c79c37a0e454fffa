"""The controller's process: ``python -m hil.backends.controller_node FD PARENT`` with the file descriptor of its pipe.

A fresh process, not a fork: Zenoh's threads do not survive a fork, and the launcher may have used Zenoh before.
"""

from __future__ import annotations

import signal
import sys
from multiprocessing.connection import Connection

from hil.backends.lifecycle import die_with_parent, quiet_collector


def main(descriptor: int, parent: int) -> None:
    """Build the controller that the pipe's first message describes, and answer samples until killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's to handle
    die_with_parent(parent)
    pipe = Connection(descriptor)
    run, robot, config, router = pipe.recv()

    import zenoh

    from bus.zenoh_link import MalformedBundleError, declare_publisher, keys, session_config
    from central_controller.controller import Controller
    from hil.backends.inline import serve
    from hil.backends.state_pipe import serve_pipe
    from hil.compiled import compile_function
    from robots import description

    controller = Controller(description.load(robot, config.variant), config, compile=compile_function)
    endpoint = pipe.recv()  # the launcher's session listens by now
    session = zenoh.open(session_config(None, endpoint, router=router is not None))
    names = keys(run)
    inbox = session.declare_subscriber(names.state, zenoh.handlers.FifoChannel(64))
    publisher = declare_publisher(session, names.command)
    pipe.send("ready")
    quiet_collector()
    while True:
        bundle = inbox.recv().payload.to_bytes()
        if not bundle:
            serve_pipe(controller, pipe)
            continue
        try:
            publisher.put(serve(controller, bundle))
        except MalformedBundleError as error:  # not from the launcher, which awaits its own answer
            sys.stderr.write(f"controller: ignored a malformed sample ({error})\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
