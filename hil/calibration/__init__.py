"""Calibration of the joints' absolute encoders: the file, and how the offsets are found over the bus."""
