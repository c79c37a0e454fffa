"""Names of files for what has names of its own."""

from __future__ import annotations

import hashlib
import re

_LONGEST = 150


def file_name(text: str) -> str:
    """A file's name for ``text``: without anything that a shell or a file system minds, and not too long."""
    name = re.sub(r"[^\w.=-]+", "_", text).strip("_")
    if len(name) > _LONGEST:
        name = f"{name[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    return name or "_"
