"""What runs on a joint's DSP: sensing, control law, drive state machine, protection."""
