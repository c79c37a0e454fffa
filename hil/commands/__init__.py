"""The subcommands of ``hil``, one module each; ``hil.cli`` puts them together."""
