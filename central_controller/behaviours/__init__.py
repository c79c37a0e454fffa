"""What the controller does with the robot once the drives are on: one class per behaviour."""

from central_controller.behaviours.behaviour import Behaviour
from central_controller.behaviours.open_loop import OpenLoop
from central_controller.behaviours.stand import Stand
from central_controller.behaviours.step import Step

BEHAVIOURS: dict[str, type[Behaviour]] = {"stand": Stand, "step": Step, "open_loop": OpenLoop}  # by configured name
