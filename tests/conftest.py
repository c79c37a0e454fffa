"""Settings of all tests: no deadline for hypothesis, whose examples share two busy cores with processes under test."""

import signal

from hypothesis import settings

settings.register_profile("hil", deadline=None, print_blob=True)
settings.load_profile("hil")

# A shell that starts tests in the background lets them ignore SIGINT, and with them all programs that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
