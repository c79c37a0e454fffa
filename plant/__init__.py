"""The physical world: robots, actuators, terrain, sensors, in MuJoCo."""
