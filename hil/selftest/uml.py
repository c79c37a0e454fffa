"""User-mode Linux: a Linux kernel as an ordinary process, for what the kernel here has not (CAN).

The guest sees the files of the host, read-only, and runs as the user who started it. Debian's package
``user-mode-linux`` brings kernel and modules.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from hil.errors import EmulationError, UserError
from hil.selftest import guard

PACKAGES = "user-mode-linux can-utils iproute2 kmod"
_MODULES = Path("/usr/lib/uml/modules")
_KERNEL = "linux.uml"
_STATUS = "uml-init: status "  # begins the last line that the boot script writes
_MEMORY_MB = 1536  # the file behind it is sparse
# Without AVX: with it, runs had another digest in a few boots of many, for a reason that was not found.
_ENVIRONMENT = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-AVX512F,-AVX512VL,-AVX512BW,-FMA,-BMI2,-ERMS,-XSAVE,-XSAVEC",
    "PYTHONDONTWRITEBYTECODE": "1",
    "TMPDIR": "/run/tmp",
    "XDG_CACHE_HOME": "/run/cache",
    "HOME": "/run",
}


def require() -> None:
    """Raises UserError, with what to install, when user-mode Linux or what the guest needs is missing."""
    missing = [name for name in (_KERNEL, "candump", "ip", "insmod") if _which(name) is None]
    if not list(_MODULES.glob("*/kernel/drivers/net/can/vcan.ko")):
        missing.append("vcan module of user-mode Linux")
    if missing:
        raise UserError(f"{', '.join(missing)} not found: on Debian or Ubuntu `apt-get install {PACKAGES}`")


def _which(name: str) -> str | None:
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin", "/usr/bin"]))


def _script(command: Sequence[str]) -> str:
    """What the guest's shell runs: ``command`` in this directory and environment."""
    variables = {name: os.environ[name] for name in ("PATH", "PYTHONPATH", "LANG", "LC_ALL") if name in os.environ}
    exports = [f"export {name}={shlex.quote(value)}" for name, value in {**variables, **_ENVIRONMENT}.items()]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hume-hil"
    copy = f"mkdir -p -m 700 /run/cache/hume-hil; cp {shlex.quote(str(cache))}/* /run/cache/hume-hil/ 2>/dev/null"
    return "\n".join([*exports, copy, f"cd {shlex.quote(os.getcwd())}", shlex.join(command), ""])


def _room_for_memory(directory: str) -> str:
    """Where the file behind the guest's memory goes: shared memory when it is large enough, else the disk."""
    try:
        status = os.statvfs("/dev/shm")
    except OSError:
        return directory
    return "/dev/shm" if status.f_bavail * status.f_frsize > _MEMORY_MB << 20 else directory


class Guest:
    """A boot of user-mode Linux that runs ``command``: iterate over the lines of its console, then read ``status``.

    Nothing of it is left behind, whatever ends this process.
    """

    def __init__(self, command: Sequence[str], limit_s: float) -> None:
        require()
        self._limit_s = limit_s
        self._said: int | None = None
        directory = tempfile.mkdtemp(prefix="hil-uml-")
        (Path(directory) / "command").write_text(_script(command), encoding="utf-8")
        init = Path(directory) / "init"
        init.write_bytes(Path(__file__).with_name("uml-init.sh").read_bytes())
        init.chmod(0o700)
        linux = [
            _which(_KERNEL) or _KERNEL, f"mem={_MEMORY_MB}M", "root=/dev/root", "rootfstype=hostfs", "rootflags=/",
            "ro", "quiet", f"uml_dir={directory}/", f"init={init}", f"HIL_WORK={directory}",
            "con=null", "con0=null,fd:1",
        ]  # fmt: skip
        self._guard = subprocess.Popen(
            [sys.executable, guard.__file__, directory, str(limit_s), *linux],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
            text=True, errors="replace", env={**os.environ, "TMPDIR": _room_for_memory(directory)},
        )  # fmt: skip

    def __iter__(self) -> Iterator[str]:
        assert self._guard.stdout is not None
        for line in self._guard.stdout:
            text = line.rstrip("\r\n")
            if text.startswith(_STATUS):
                self._said = int(text.removeprefix(_STATUS))
                self.close()
                return
            yield text

    @property
    def status(self) -> int:
        """Exit status of the command. Raises EmulationError when the guest did not get so far."""
        ended = self._guard.wait()  # at once: its output has ended
        if self._said is None:
            why = f"not done within {self._limit_s:.0f} s" if ended == guard.TIMEOUT else f"ended with status {ended}"
            raise EmulationError(f"user-mode Linux: {why}")
        return self._said

    def close(self) -> None:
        """End the guest now, if it has not ended."""
        self._guard.communicate()  # the end of its input is the guard's sign

    def __enter__(self) -> Guest:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
