"""What the controller does with the robot once the drives are on: one class per behaviour."""

from central_controller.behaviours.open_loop import OpenLoop
from central_controller.behaviours.stand import Stand

BEHAVIOURS = {"stand": Stand, "open_loop": OpenLoop}  # by the names that the configuration gives them
