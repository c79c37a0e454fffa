"""The whole sampled loop linearised by perturbing and restoring snapshots: modes, and where they become unstable."""
