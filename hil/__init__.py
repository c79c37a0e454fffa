"""Command line, scenarios, backends and clocks, recorder, reports."""
