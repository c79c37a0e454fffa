"""CasADi functions as compiled C where a compiler exists, else in CasADi's virtual machine: equal results.

``-ffp-contract=off`` and no ``-march`` keep the arithmetic of the C code bit for bit that of the virtual
machine. Shared objects are cached for the user, keyed by the C source, the compiler and its flags. Whatever
goes wrong on the way (no compiler, a broken one, a full disk) costs speed, never the run.
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
_SEAL = hashlib.sha256().digest_size


@cache
def compiler() -> str | None:
    """Path of the C compiler and first line of its version, or None without a working one."""
    path = shutil.which("cc") or shutil.which("gcc")
    if path is None:
        return None
    try:
        answer = subprocess.run(
            [path, "--version"], capture_output=True, text=True, errors="replace", timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    lines = answer.stdout.splitlines()
    return f"{path}: {lines[0]}" if lines else None


def cache_directory() -> Path | None:
    """The user's cache for shared objects, or None when there is none that only this user can write to."""
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        directory = root / "hume-hil"
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = directory.stat()
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        return None
    if status.st_uid != os.getuid() or status.st_mode & 0o022:
        return None  # somebody else could have put code there
    return directory


def compile_function(function: ca.Function) -> ca.Function:
    """``function`` compiled to C, or itself when that is not possible."""
    version = compiler()
    if version is None:
        return function
    try:
        with tempfile.TemporaryDirectory() as scratch:
            return _compile(function, version, Path(scratch)) or function
    except (OSError, RuntimeError, subprocess.SubprocessError):  # RuntimeError: no code for this function
        return function


def _compile(function: ca.Function, version: str, scratch: Path) -> ca.Function | None:
    source = _generate(function, scratch)
    flags = list(_FLAGS)
    if source.stat().st_size > _LARGE_SOURCE:
        flags[0] = "-O1"
    key = hashlib.sha256("\0".join([version, *flags]).encode() + source.read_bytes()).hexdigest()[:32]
    directory = cache_directory()
    target = directory / f"{function.name()}-{key}.so" if directory else None
    if target is not None and _sealed(target):
        loaded = _load(function, target)
        if loaded is not None:
            return loaded
    fresh = scratch / "fresh.so"
    command = [version.partition(": ")[0], *flags, "-o", str(fresh), str(source), "-lm"]
    subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=True)
    if target is not None and _store(fresh, target):
        loaded = _load(function, target)
        if loaded is not None:
            return loaded
    return _load(function, fresh)  # no cache, or one on a file system that may not hold programs


def _generate(function: ca.Function, scratch: Path) -> Path:
    """Write the C source; CasADi's generator takes a bare file name and a folder to prepend."""
    generator = ca.CodeGenerator("law.c", {"with_header": False})
    generator.add(function)
    return Path(generator.generate(f"{scratch}/"))


def _store(fresh: Path, target: Path) -> bool:
    """Put ``fresh`` into the cache as ``target``, sealed by its digest; False if it cannot be put there."""
    code = fresh.read_bytes()
    try:
        descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=".new-")
    except OSError:
        return False
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(code + hashlib.sha256(code).digest())
        os.replace(name, target)  # atomic: another process may be doing the same
    except OSError:
        Path(name).unlink(missing_ok=True)
        return False
    return True


def _sealed(target: Path) -> bool:
    """Whether ``target`` is there and whole: loading a truncated object would kill the process (SIGBUS)."""
    try:
        data = target.read_bytes()
    except OSError:
        return False
    return hashlib.sha256(data[:-_SEAL]).digest() == data[-_SEAL:]


def _load(function: ca.Function, target: Path) -> ca.Function | None:
    try:
        loaded = ca.external(function.name(), str(target))
    except RuntimeError:
        return None  # no shared object of this architecture: build it again
    same = (loaded.n_in(), loaded.n_out()) == (function.n_in(), function.n_out())
    return loaded if same else None
