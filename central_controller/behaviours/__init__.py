"""What the controller does with the robot once the drives are on: one class per behaviour."""

from central_controller.behaviours.stand import Stand

BEHAVIOURS = {"stand": Stand}  # by the names that the configuration gives them
