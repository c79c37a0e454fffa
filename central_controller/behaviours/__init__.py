"""What the controller does with the robot once the drives are on: one class per behaviour."""

from central_controller.behaviours.stand import Stand
from central_controller.behaviours.step import Step

BEHAVIOURS = {"stand": Stand, "step": Step}  # by the names that the configuration gives them
