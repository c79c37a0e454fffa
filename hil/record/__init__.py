"""The record of a run: signals (MCAP), bus logs, and the journal of what came from outside."""
