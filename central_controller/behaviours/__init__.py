"""What the controller does with the robot once the drives are on: one class per behaviour."""

from central_controller.behaviours.behaviour import Behaviour


def behaviour_class(name: str) -> type[Behaviour]:
    """The behaviour of this configured name. It is imported here: planning an open loop takes SciPy's splines, which
    take longer to load than all of the others together."""
    if name == "stand":
        from central_controller.behaviours.stand import Stand

        return Stand
    if name == "step":
        from central_controller.behaviours.step import Step

        return Step
    from central_controller.behaviours.open_loop import OpenLoop

    return OpenLoop
