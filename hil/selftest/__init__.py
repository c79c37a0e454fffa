"""Real SocketCAN where the kernel has none: user-mode Linux, and what is tested inside it."""
