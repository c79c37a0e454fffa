"""Estimators: what the sensors say of the robot's state, beyond the servo tick's own filters (docs/estimation.md)."""
