"""Libraries that only some commands need, and that are not installed with everything else."""

from __future__ import annotations

import importlib

from hil.errors import UserError


def require(*modules: str, extra: str = "lab") -> None:
    """Raise UserError, before any work is done in vain, when one of ``modules`` is not there; ``extra`` installs it."""
    for name in modules:
        try:
            importlib.import_module(name)
        except ImportError:
            raise UserError(f"this needs {name}, which is not installed: pip install 'hume-hil[{extra}]'") from None
