"""CasADi functions as compiled C where a compiler exists, else in CasADi's virtual machine, with identical results.

``-ffp-contract=off`` and no ``-march`` keep the arithmetic of the C code bit for bit that of the virtual machine.
Shared objects are cached for the user, keyed by the C source, the compiler and its flags.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import casadi as ca

_FLAGS = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
_LARGE_SOURCE = 400_000  # bytes; beyond it -O1 compiles several times faster and runs hardly slower
_TIMEOUT_S = 120


@cache
def compiler() -> str | None:
    """First line of the C compiler's version, or None without a compiler."""
    path = shutil.which("cc") or shutil.which("gcc")
    if path is None:
        return None
    try:
        answer = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{path}: {answer.stdout.splitlines()[0]}"


def cache_directory() -> Path | None:
    """The user's private cache for shared objects, or None when there is none that only this user can write to."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    directory = root / "hume-hil"
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = directory.stat()
    except OSError:
        return None
    if status.st_uid != os.getuid() or status.st_mode & 0o022:
        return None  # somebody else could have put code there
    return directory


def compile_function(function: ca.Function) -> ca.Function:
    """``function`` compiled to C, or itself when that is not possible."""
    version = compiler()
    if version is None:
        return function
    with tempfile.TemporaryDirectory() as scratch:
        source = _generate(function, Path(scratch))
        flags = list(_FLAGS)
        if source.stat().st_size > _LARGE_SOURCE:
            flags[0] = "-O1"
        key = hashlib.sha256("\0".join([version, *flags]).encode() + source.read_bytes()).hexdigest()[:32]
        directory = cache_directory()
        target = (directory or Path(scratch)) / f"{function.name()}-{key}.so"
        if target.exists():
            loaded = _load(function, target)
            if loaded is not None:
                return loaded
        fresh = Path(scratch) / "fresh.so"
        command = [version.split(":")[0], *flags, "-o", str(fresh), str(source), "-lm"]
        try:
            subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=True)
        except (OSError, subprocess.SubprocessError):
            return function
        if directory is not None:  # atomic: another process may be doing the same
            descriptor, name = tempfile.mkstemp(dir=directory, prefix=".new-")
            os.close(descriptor)
            shutil.copyfile(fresh, name)
            os.replace(name, target)
        else:
            target = fresh
        return _load(function, target) or function


def _generate(function: ca.Function, scratch: Path) -> Path:
    """Write the C source; CasADi's generator takes a bare file name and a folder to prepend."""
    generator = ca.CodeGenerator("law.c", {"with_header": False})
    generator.add(function)
    return Path(generator.generate(f"{scratch}/"))


def _load(function: ca.Function, target: Path) -> ca.Function | None:
    try:
        loaded = ca.external(function.name(), str(target))
    except RuntimeError:
        return None  # truncated or of another architecture: build it again
    same = (loaded.n_in(), loaded.n_out()) == (function.n_in(), function.n_out())
    return loaded if same else None
