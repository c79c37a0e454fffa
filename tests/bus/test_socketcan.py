"""What of SocketCAN can be tested on any kernel; `hil socketcan-selftest` tests the rest on one that has CAN."""

import subprocess

import pytest

from bus import socketcan
from bus.socketcan import Interfaces, SocketCanError, commands, exists


def test_a_kernel_without_can_is_told_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "supported", lambda: False)
    with pytest.raises(SocketCanError, match=r"no CAN sockets: .*modprobe -a can can-raw vcan.*socketcan-selftest"):
        Interfaces(["left_leg"])


@pytest.mark.parametrize("name", ["a_leg_of_sixteen", "left/leg", "left leg", "left:leg", "", "..", "rückwärts_links"])
def test_names_that_the_kernel_refuses(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(socketcan, "supported", lambda: True)
    with pytest.raises(SocketCanError, match="cannot name a network interface"):
        Interfaces([name])


def test_an_interface_that_may_not_be_made_is_told_with_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "supported", lambda: True)

    def refuse(*arguments: str) -> None:
        raise subprocess.CalledProcessError(2, "ip", output="RTNETLINK answers: Operation not permitted\n")

    monkeypatch.setattr(Interfaces, "_ip", staticmethod(refuse))
    with pytest.raises(SocketCanError) as caught:
        Interfaces(["nocan.4", "nocan.5"])
    assert str(caught.value) == (
        "CAN interface nocan.4 is missing and cannot be created (RTNETLINK answers: Operation not permitted); type: "
        "for i in nocan.4 nocan.5; do sudo ip link add dev $i type vcan; sudo ip link set dev $i mtu 72 up; done"
    )


def test_existing_interfaces_are_used_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "supported", lambda: True)
    monkeypatch.setattr(socketcan, "exists", lambda name: True)
    monkeypatch.setattr(Interfaces, "_ip", staticmethod(lambda *_: pytest.fail("nothing is to be created")))
    Interfaces(["can0"]).close()


def test_two_runs_do_not_share_an_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "supported", lambda: True)
    monkeypatch.setattr(socketcan, "exists", lambda name: True)
    with Interfaces(["shared.1", "shared.2"]):
        with pytest.raises(SocketCanError, match=r"another run uses the CAN interface shared\.2"):
            Interfaces(["shared.3", "shared.2"])
        Interfaces(["shared.3"]).close()  # the one that was refused keeps nothing
    Interfaces(["shared.1", "shared.2"]).close()


def test_only_a_can_interface_counts_as_one() -> None:
    assert not exists("lo")
    assert not exists("nosuchinterface")


def test_the_commands_are_valid_shell() -> None:
    assert subprocess.run(["sh", "-n", "-c", commands(["left_leg", "left_leg.4"])]).returncode == 0
