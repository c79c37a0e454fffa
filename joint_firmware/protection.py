"""Error codes of the drive's protection (CiA 301 and CiA 402) and the limits that trigger them."""

from __future__ import annotations

NO_ERROR = 0x0000  # what an emergency says when the last error is gone (CiA 301)
WATCHDOG = 0x8130  # life guard: the controller has been silent, or the node was stopped
POSITION_LIMIT = 0x8612  # reference limit: joint far beyond its limits
OVER_TORQUE = 0x2310  # continuous over-current class: the spring carries more than the drive may ask for

POSITION_MARGIN = 0.2  # rad beyond a joint limit
TORQUE_FACTOR = 1.5  # of the torque limit

# error register bits (CiA 301 object 0x1001)
GENERIC = 0x01  # set with any error
CURRENT = 0x02
COMMUNICATION = 0x10
PROFILE = 0x20  # what the device profile defines
_CLASSES = {NO_ERROR: 0, WATCHDOG: COMMUNICATION, POSITION_LIMIT: PROFILE, OVER_TORQUE: CURRENT}


def register(code: int) -> int:
    """The error register while ``code`` is the error in force."""
    return GENERIC | _CLASSES[code] if code else 0
