"""Coverage-guided fuzzing of every target, bounded in time: ``python -m tests.fuzz.run --seconds 20``.

Each target runs in a process of its own under atheris (libFuzzer), from well-formed input on; an input that takes more
than five seconds or two gigabytes is a finding, too. Where atheris is not installed the seeds are mutated at random
instead, and the output says so. Exit status: 0 nothing found, 1 found, with the input's bytes.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import random
import re
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_GRACE_S = 60.0  # to start and to stop


def _defect(data: bytes) -> None:
    """A known defect, to see that the fuzzer finds one."""
    assert data[:3] != b"BUG", "the defect"


def fuzz(names: list[str], seconds: float) -> list[str]:
    """Fuzz ``names`` for ``seconds`` in all, two at a time; print one line each. Returns those with a finding."""
    share, failed = 2.0 * seconds / max(len(names), 2), []
    waiting, running = list(names), {}
    with tempfile.TemporaryDirectory() as directory:
        while waiting or running:
            while waiting and len(running) < 2:
                name = waiting.pop(0)
                command = [sys.executable, "-m", "tests.fuzz.run", "--child", name, "--seconds", str(share)]
                command += ["--directory", directory]
                output = (Path(directory) / f"{name}.txt").open("w+")
                child = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, cwd=_ROOT
                )
                running[name] = child, output, time.monotonic() + share + _GRACE_S
            ends = [os.pidfd_open(child.pid) for child, *_ in running.values()]
            select.select(ends, [], [], max(0.0, min(until for *_, until in running.values()) - time.monotonic()))
            for descriptor in ends:
                os.close(descriptor)
            for name, (child, output, until) in list(running.items()):
                hung = time.monotonic() > until
                if hung:
                    child.kill()
                if child.poll() is None and not hung:
                    continue
                child.wait()
                del running[name]
                output.seek(0)
                text = output.read()
                output.close()
                runs = re.findall(r"(?:^#|Done )(\d+)", text, re.MULTILINE)
                how = "at random, atheris is not installed" if "at random" in text else "guided by coverage"
                result = "hung" if hung else "nothing found" if child.returncode == 0 else "FOUND"
                print(f"{name:12} {result:14} {runs[-1] if runs else '?':>9} inputs, {how}", flush=True)
                if result != "nothing found":
                    failed.append(name)
                    print(text[-6000:], flush=True)
    return failed


def _child(name: str, seconds: float, directory: Path) -> None:
    corpus = directory / name
    corpus.mkdir()
    if importlib.util.find_spec("atheris") is None:
        from tests.fuzz.targets import TARGETS

        check, seeds = (_defect, [b"BUG"]) if name == "defect" else (TARGETS[name].check, TARGETS[name].seeds())
        at_random(check, seeds, seconds)
        return
    import atheris

    if name == "defect":
        check = atheris.instrument_func(_defect)
    else:
        # modules are instrumented as they are imported: here for the first time
        with atheris.instrument_imports(include=["bus", "hil", "robots", "joint_firmware"]):
            from tests.fuzz.targets import TARGETS
        check = TARGETS[name].check
        for n, seed in enumerate(TARGETS[name].seeds()):
            (corpus / f"seed-{n}").write_bytes(seed)
    limits = [f"-max_total_time={max(round(seconds), 1)}", "-timeout=5", "-rss_limit_mb=2048", "-max_len=20000"]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={corpus}/found-", str(corpus)], check)
    atheris.Fuzz()


def at_random(check: Callable[[bytes], object], seeds: list[bytes], seconds: float) -> None:
    """Call ``check`` with mutated ``seeds`` for a while; what it raises comes out, after the input is printed."""
    draw, count, end = random.Random(1), 0, time.monotonic() + seconds
    print("at random", flush=True)
    while time.monotonic() < end:
        data = bytearray(draw.choice(seeds))
        for _ in range(draw.randrange(4)):
            if data:
                data[draw.randrange(len(data))] = draw.randrange(256)
        if draw.randrange(4) == 0:
            del data[draw.randrange(len(data) + 1) :]
        try:
            check(bytes(data))
        except BaseException:
            print(f"input: {bytes(data)!r}", flush=True)
            raise
        count += 1
    print(f"Done {count}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="time in all (20)")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--directory", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("target", nargs="*", help="default: all")
    options = parser.parse_args()
    if options.child:
        _child(options.child, options.seconds, options.directory)
        return 0
    from tests.fuzz.targets import TARGETS

    unknown = set(options.target) - set(TARGETS)
    if unknown:
        parser.error(f"no target {', '.join(sorted(unknown))}; there is {', '.join(TARGETS)}")
    return 1 if fuzz(options.target or list(TARGETS), options.seconds) else 0


if __name__ == "__main__":
    sys.exit(main())
