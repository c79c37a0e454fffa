"""Where nodes run: all in one process (inline), or each in its own (processes)."""
