"""Models of actuators: the interface, those that come with the project, and the bank that steps them all."""

from plant.actuators import hydraulic as hydraulic  # a model registers what it describes when it is imported
from plant.actuators import sea as sea
from plant.actuators import vlca as vlca
