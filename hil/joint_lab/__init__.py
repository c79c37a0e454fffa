"""One joint in the laboratory: the theory of its torque loop, and the same loop measured through the emulation."""
