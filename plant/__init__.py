"""The physical world: robots, actuators, terrain, sensors, in MuJoCo."""

import os

# MuJoCo chooses its OpenGL when it is first imported: there need not be a screen.
os.environ.setdefault("MUJOCO_GL", "egl")
