"""What runs without a scenario: a bus by itself, and one emulated joint on any bus."""
