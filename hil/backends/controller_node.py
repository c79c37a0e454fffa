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
    run, robot, config = pipe.recv()

    import zenoh

    from bus.zenoh_link import (
        MalformedBundleError,
        Refused,
        declare_publisher,
        decode_bundle,
        encode_bundle,
        keys,
        peer_config,
    )
    from central_controller.controller import Controller
    from hil.backends.inline import tick
    from hil.backends.state_pipe import serve_pipe
    from hil.compiled import compile_function
    from robots import description

    controller = Controller(description.load(robot, config.variant), config, compile=compile_function)
    where = pipe.recv()  # the launcher's session is there by now
    session = zenoh.open(peer_config(where))
    names = keys(run)
    inbox = session.declare_subscriber(names.state, zenoh.handlers.FifoChannel(64))
    publisher = declare_publisher(session, names.command)
    pipe.send("ready")
    quiet_collector()
    refused = Refused()
    due = 1  # sequence number of the launcher's next bundle
    while True:
        payload = inbox.recv().payload.to_bytes()
        if not payload and pipe.poll():  # an empty sample: look at the pipe
            serve_pipe(controller, pipe, refused=refused.report)
            continue
        try:
            request = decode_bundle(payload)
        except MalformedBundleError as error:
            refused.count(error)
            continue
        if request.sequence != due:  # a stranger's, and well formed: it must not move the controller
            refused.unexpected += 1
            continue
        due = (due + 1) & 0xFFFFFFFF
        now = request.time_ns
        answer = [(now, *command) for command in tick(controller, now, request.items)]
        publisher.put(encode_bundle(request.sequence, now, answer, controller.telemetry))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
