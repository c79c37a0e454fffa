"""Error codes of the drive's protection (CiA 301 and CiA 402) and the limits that trigger them."""

from __future__ import annotations

NO_ERROR = 0x0000  # what an emergency says when the last error is gone (CiA 301)
WATCHDOG = 0x8130  # life guard: the controller has been silent
POSITION_LIMIT = 0x8611  # joint far beyond its limits
OVER_TORQUE = 0x2310  # continuous over-current class: the spring carries more than the drive may ask for

POSITION_MARGIN = 0.2  # rad beyond a joint limit
TORQUE_FACTOR = 1.5  # of the torque limit

GENERIC_ERROR = 0x01  # error register bits (CiA 301 object 0x1001)
COMMUNICATION_ERROR = 0x10
