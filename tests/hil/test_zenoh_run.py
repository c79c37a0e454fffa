"""Runs over a Zenoh router, plain and with TLS and access control; what strangers send is counted and ignored."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from bus.zenoh_link import encode_bundle, keys, peer_config, session_config
from hil.cli import main
from hil.run import Assembly, Request, run
from hil.scenario import load

EXAMPLES = Path(__file__).parents[2] / "docs" / "zenoh"
NOTHING = {"malformed": 0, "wrong_version": 0, "unexpected": 0}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


_ROUTER = """
import sys, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("up", flush=True)
    sys.stdin.read()
"""


def start_router(file: Path) -> subprocess.Popen[str]:
    """A router in a process of its own, that ends when its input does."""
    router = subprocess.Popen(
        [sys.executable, "-c", _ROUTER, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert router.stdout is not None and router.stdout.readline() == "up\n"
    return router


@pytest.fixture
def router(tmp_path: Path) -> Iterator[str]:
    """Endpoint of a router without TLS."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "router.json5"
    file.write_text(
        f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
    )
    process = start_router(file)
    yield endpoint
    process.communicate(timeout=20)


def digest(**more: Any) -> str:
    return run(Request(load("stand", ["duration=0.1s"]), seed=2, **more)).record["log_digest"]


def garbage(version: int) -> list[bytes]:
    """A sample of another version, two malformed ones, an empty one, and one that is well formed and not due."""
    bundle = encode_bundle(1_000_000, 0, [(0, 0, 0x200, bytes(64))], np.zeros(3))
    return [bundle[:2] + bytes([version]) + bundle[3:], b"garbage", bundle[:-1], b"", bundle]


def send(session: zenoh.Session, key: str, samples: list[bytes], expect_listener: bool = True) -> None:
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    while expect_listener and not publisher.matching_status.matching:
        os.sched_yield()
    for sample in samples:
        publisher.put(sample)


def test_a_run_over_a_router_ignores_and_counts_what_strangers_send(router: str) -> None:
    with zenoh.open(session_config(None, router, router=True)) as stranger:

        def prepare(assembly: Assembly) -> None:
            names = keys(assembly.run_name)
            send(stranger, names.state, garbage(version=9))
            send(stranger, names.command, garbage(version=9))

        request = Request(load("stand", ["duration=0.1s"]), seed=2, zenoh=router)
        record = run(request, prepare=prepare).record
    counted = {"malformed": 3, "wrong_version": 1, "unexpected": 1}
    assert record["link"] == {"launcher": counted, "controller": counted}
    assert record["log_digest"] == digest(backend="inline")


def test_a_run_without_strangers_has_ignored_nothing() -> None:
    record = run(Request(load("stand", ["duration=0.05s"]))).record
    assert record["link"] == {"launcher": NOTHING, "controller": NOTHING}
    assert run(Request(load("stand", ["duration=0.05s"]), backend="inline")).record["link"] is None


def test_injecting_reaches_a_run_over_a_router(router: str, tmp_path: Path) -> None:
    out = tmp_path / "over-a-router"
    command = [sys.executable, "-m", "hil", "run", "stand", "--duration", "100s", "--zenoh", router, "--json"]
    with subprocess.Popen([*command, "--out", str(out)], stdout=subprocess.PIPE, text=True) as process:
        try:
            log = out / "left_leg.log"
            while not (log.exists() and log.stat().st_size):
                with pytest.raises(subprocess.TimeoutExpired):
                    process.wait(0.05)
            inject = [sys.executable, "-m", "hil", "inject", "link.command.delay", "1ms", "--run", out.name]
            done = subprocess.run(inject, capture_output=True, text=True, timeout=60)
            assert done.returncode == 0, done.stderr
        finally:
            process.terminate()
        assert process.stdout is not None
        record = json.loads(process.stdout.read())
    assert [i["key"] for i in record["injected"]] == ["link.command.delay"]


# --- TLS --------------------------------------------------------------------------------------------------------


def openssl(directory: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=directory, check=True, capture_output=True)


def issue(directory: Path, name: str) -> None:
    """A key and a certificate with the common name ``name``, for this host, by the test's own authority."""
    openssl(directory, "req", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-out", f"{name}.csr",
            "-subj", f"/CN={name}")  # fmt: skip
    (directory / "san").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    openssl(directory, "x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial",
            "-days", "2", "-extfile", "san", "-out", f"{name}.pem")  # fmt: skip


@pytest.fixture
def secured(tmp_path: Path) -> Iterator[Path]:
    """The directory with the documented example for this host, its certificates made, its router running."""
    openssl(tmp_path, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem",
            "-days", "2", "-subj", "/CN=test authority")  # fmt: skip
    for name in ("router", "hil", "stranger"):
        issue(tmp_path, name)
    port = free_port()
    for name in ("router.json5", "hil.json5"):
        text = (EXAMPLES / name).read_text()
        text, ends = re.subn(r"tls/[\w.-]+:7447", f"tls/localhost:{port}", text)
        assert ends == 1
        (tmp_path / name).write_text(text.replace("/etc/hil/", f"{tmp_path}/"))
    (tmp_path / "stranger.json5").write_text((tmp_path / "hil.json5").read_text().replace("/hil.", "/stranger."))
    process = start_router(tmp_path / "router.json5")
    yield tmp_path
    process.communicate(timeout=20)


def test_a_run_over_tls_is_closed_to_strangers(secured: Path) -> None:
    stranger = zenoh.open(peer_config(f"config:{secured / 'stranger.json5'}"))  # of the same authority
    member = zenoh.open(peer_config(f"config:{secured / 'hil.json5'}"))
    with stranger, member:

        def prepare(assembly: Assembly) -> None:
            names = keys(assembly.run_name)
            send(stranger, names.state, garbage(version=9), expect_listener=False)
            send(member, names.state, [b"from a member"])

        request = Request(load("stand", ["duration=0.1s"]), seed=2, zenoh_config=secured / "hil.json5")
        record = run(request, prepare=prepare).record
    assert record["link"] == {"launcher": NOTHING, "controller": {**NOTHING, "malformed": 1}}
    assert record["log_digest"] == digest(backend="inline")


def test_without_a_certificate_nobody_joins(secured: Path) -> None:
    text = (secured / "hil.json5").read_text()
    anonymous = re.sub(r"connect_(certificate|private_key).*\n|enable_mtls.*\n", "", text)
    assert anonymous.count("\n") == text.count("\n") - 3
    (secured / "anonymous.json5").write_text(anonymous)
    with pytest.raises(zenoh.ZError):
        zenoh.open(peer_config(f"config:{secured / 'anonymous.json5'}"))


def test_what_a_configuration_leaves_out_is_off(tmp_path: Path) -> None:
    file = tmp_path / "peer.json5"
    file.write_text('{mode: "peer", connect: {endpoints: ["tcp/127.0.0.1:7447"]}}')
    config = peer_config(f"config:{file}")
    assert config.get_json("listen/endpoints") == "[]"
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("connect/endpoints") == '["tcp/127.0.0.1:7447"]'
    file.write_text('{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:0"]}}')
    assert peer_config(f"config:{file}").get_json("listen/endpoints") == '["tcp/127.0.0.1:0"]'


@pytest.mark.parametrize("text", [None, "{mode: ", '{mod: "client"}', '{mode: "clent"}'])
def test_a_configuration_that_zenoh_does_not_read_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None
) -> None:
    file = tmp_path / "mine.json5"
    if text is not None:
        file.write_text(text)
    out = tmp_path / "out"
    assert main(["run", "stand", "--zenoh-config", str(file), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(file) in error
    assert not out.exists()


@pytest.mark.parametrize("other", [["--zenoh", "tcp/127.0.0.1:7447"], ["--backend", "inline"]])
def test_a_configuration_excludes(tmp_path: Path, capsys: pytest.CaptureFixture[str], other: list[str]) -> None:
    assert main(["run", "stand", "--zenoh-config", "x.json5", *other]) == 2
    assert "exclude each other" in capsys.readouterr().err
