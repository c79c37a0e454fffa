"""Builds and runs exported laws with the tools of this machine."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from hil.record.law_recording import LawRecording, parameter_lines
from joint_firmware.export.c99 import PRECISIONS

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wshadow", "-Wconversion", "-Wdouble-promotion")
ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-O2")
QEMU = (
    "qemu-system-arm", "-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none",
    "-semihosting-config", "enable=on,target=native",
)  # fmt: skip


def need(command: str, package: str) -> None:
    """Without ``command`` the test says so and is counted as skipped."""
    if shutil.which(command) is None:
        pytest.skip(f"{command} is not here: apt-get install {package}")


def need_m32(directory: Path) -> None:
    """Without a C library for 32-bit x86 the test says so and is counted as skipped."""
    need("cc", "gcc libc6-dev")
    source = directory / "m32.c"
    source.write_text("#include <math.h>\nint main(int n, char **v) { (void)v; return floor(n + 0.5) != 1; }\n")
    built = subprocess.run(["cc", "-m32", "-o", "m32", source.name, "-lm"], cwd=directory, capture_output=True)
    if built.returncode or subprocess.run([directory / "m32"], capture_output=True).returncode:
        pytest.skip("cc -m32 makes no program here: apt-get install libc6-dev-i386 lib32gcc-12-dev (on x86)")


def write(files: dict[str, str], directory: Path) -> Path:
    directory.mkdir(exist_ok=True)
    for name, text in files.items():
        (directory / name).write_text(text, encoding="utf-8")
    return directory


def build(directory: Path, *flags: str, name: str = "built") -> Path:
    """The example of an export, compiled without a warning."""
    need("cc", "gcc libc6-dev")
    sources = sorted(path.name for path in directory.glob("*.c"))
    command = ["cc", *STRICT, "-ffp-contract=off", *flags, "-o", name, *sources, "-lm"]
    result = subprocess.run(command, cwd=directory, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return directory / name


def rows(recording: LawRecording) -> str:
    """What the example reads."""
    return "".join(line + "\n" for line in parameter_lines(recording)) + "".join(
        ",".join([*map(str, counts), *map(repr, u)]) + "\n"
        for counts, u in zip(recording.counts.tolist(), recording.u.tolist(), strict=True)
    )


def run(command: Sequence[str | Path], text: str) -> str:
    result = subprocess.run(command, input=text, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return result.stdout


def numbers(text: str, precision: str) -> np.ndarray:
    """What the example prints, a row per step, in the type that it computes in."""
    kind = {"double": np.float64, "single": np.float32}[precision]
    assert PRECISIONS[precision].size == np.dtype(kind).itemsize
    return np.array([line.split(",") for line in text.splitlines()]).astype(np.float64).astype(kind)


def same_bits(ours: np.ndarray, theirs: np.ndarray) -> bool:
    return ours.dtype == theirs.dtype and ours.shape == theirs.shape and ours.tobytes() == theirs.tobytes()
