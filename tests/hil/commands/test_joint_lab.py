"""``hil joint margins``, ``chirp`` and ``step`` as a user calls them."""

import json

import pytest

from hil import cli

PRINTED = {"PD_m": 47.6, "PD_m+DOB": 42.8, "PID_m": 34.0, "PD_f": 17.7}  # degrees, Kim 2018 Fig. 5.10


def run(capsys, *arguments):
    """Exit status, and what went to the two outputs."""
    status = cli.main(["joint", *arguments])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def complaint(capsys, *arguments):
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert len(err.strip().splitlines()) == 1
    return err


def test_margins_are_those_of_the_source(capsys):
    status, out, _ = run(capsys, "margins", "vlca", "--json")
    assert status == 0
    found = json.loads(out)
    assert sorted(PRINTED, key=lambda law: -found[law]["phase_margin_deg"]) == list(PRINTED)
    for law, printed in PRINTED.items():
        part = found[law]
        assert part["phase_margin_deg"] == pytest.approx(printed, abs=1.5)
        # what a delay takes from the phase is ω times the delay
        assert part["delay_margin_s"] * part["crossover_hz"] * 360 == pytest.approx(part["phase_margin_deg"])
        assert 0 < part["sampled"]["delay_margin_s"] < part["delay_margin_s"]
        assert part["stable"] and part["sampled"]["stable"]


def test_one_law_with_other_gains_under_any_spelling(capsys, tmp_path):
    arguments = ("margins", "vlca", "--law", "pdm+dob", "--json", "--out", str(tmp_path))
    _, out, _ = run(capsys, *arguments)
    _, other, _ = run(capsys, *arguments, "--set", "firmware.observer_cutoff=60Hz")
    (margin,), (less,) = (
        [part["phase_margin_deg"] for part in json.loads(text).values()] for text in (out, other)
    )  # a faster observer costs phase
    assert less < margin - 3
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"{plot}-{kind}.png" for plot in ("bode", "nyquist") for kind in ("continuous", "sampled")}


def test_margins_for_a_person(capsys):
    status, out, _ = run(capsys, "margins", "hume", "--joint", "left_knee", "--law", "PD_m, cascade")
    assert status == 0
    assert "left_knee" in out and "PD_m" in out and "cascade" in out and "PID_m" not in out
    assert "passive" in out


def test_a_hydraulic_joint_has_its_one_law(capsys):
    _, out, _ = run(capsys, "margins", "valve", "--json")
    (part,) = json.loads(out).values()
    assert part["stable"] and part["sampled"]["stable"] and part["passive"] is None
    assert part["sampled"]["phase_margin_deg"] < part["phase_margin_deg"]


def test_bisected_delay_margin(capsys):
    _, out, _ = run(capsys, "margins", "hume", "--joint", "left_knee", "--law", "PD_m", "--bisect", "--json")
    sampled = json.loads(out)["PD_m"]["sampled"]
    assert sampled["delay_margin_found_s"] == pytest.approx(sampled["delay_margin_s"], abs=1 / 3000)


def test_chirp(capsys, tmp_path):
    status, out, _ = run(
        capsys, "chirp", "vlca", "--law", "PDm,open", "--from", "10Hz", "--to", "80Hz", "--duration", "1s", "--json",
        "--out", str(tmp_path),
    )  # fmt: skip
    assert status == 0
    found = json.loads(out)
    assert list(found) == ["PD_m", "open"]
    assert found["PD_m"]["torque"]["coherent_share"] == 1
    assert found["PD_m"]["torque"]["magnitude_deviation"] < 0.1
    assert found["PD_m"]["torque"]["phase_deviation_deg"] < 2
    assert found["open"]["phase_margin_deg"] is None
    assert {path.name for path in tmp_path.iterdir()} == {"chirp.png", "chirp-loop.png", "PD_m", "open"}
    assert (tmp_path / "PD_m" / "stand.log").stat().st_size > 1000


def test_chirp_of_a_valve_whose_current_is_below_the_report_s_resolution(capsys):
    status, out, _ = run(capsys, "chirp", "valve", "--from", "10Hz", "--to", "60Hz", "--duration", "1s")
    assert status == 0
    (line,) = (line for line in out.splitlines() if line.startswith("valve  "))
    assert "not measured" in line and "no crossover" in line and " 100 %" in line


def test_step_table(capsys, tmp_path):
    status, out, _ = run(
        capsys, "step", "hume", "--joint", "left_knee", "--table", "7.1", "--gains", "swing", "--duration", "0.1s",
        "--out", str(tmp_path), "--json",
    )  # fmt: skip
    assert status == 0
    rows = json.loads(out)
    assert [(row["set"], row["stiction"], row["law"]) for row in rows] == [
        ("swing", True, "cascade"), ("swing", False, "cascade")
    ]  # fmt: skip
    assert rows[0]["kp"] == pytest.approx(10 / 122 * 26.1)
    assert all(row["steady_error_nm"] is not None for row in rows)
    assert (tmp_path / "step.png").exists()


def test_step_of_another_robot_takes_the_firmware_s_gains(capsys):
    status, out, _ = run(
        capsys, "step", "vlca", "--gains", "stance", "--stiction", "off", "--law", "PD_m", "--duration", "0.1s"
    )
    assert status == 0
    assert "firmware" in out and "PD_m" in out


def test_gains_that_a_law_refuses_are_told_in_the_table(capsys):
    _, out, _ = run(
        capsys, "step", "hume", "--joint", "left_knee", "--table", "firmware", "--law", "cascade", "--gains", "stance",
        "--stiction", "off", "--set", "firmware.velocity_integral=5000", "--json",
    )  # fmt: skip
    (row,) = json.loads(out)
    assert "unstable" in row["failed"]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["margins", "vlca", "--law", "PDx"], "did you mean 'PD_m'"),
        (["margins", "nobody"], "no robot 'nobody'"),
        (["margins", "hume"], "--joint"),
        (["margins", "hume", "--joint", "left_kne"], "did you mean 'left_knee'"),
        (["margins", "valve", "--law", "PD_m"], "valid are valve"),
        (["margins", "vlca", "--load", "pendulum"], "not linear"),
        (["margins", "vlca", "--load", "locked,at=2rad"], "not to at = 2"),
        (["margins", "vlca", "--set", "link.command.delay=1ms"], "a joint alone has"),
        (["margins", "vlca", "--set", "firmware.velocity_estimator=M"], "has no derivative"),
        (["chirp", "vlca", "--from", "3"], "--from"),
        (["chirp", "vlca", "--from", "100Hz", "--to", "50Hz"], "expected them to rise"),
        (["chirp", "vlca", "--to", "2kHz"], "report rate"),
        (["chirp", "vlca", "--duration", "1s"], "two periods"),
        (["chirp", "vlca", "--set", "controller.rate=1kHz"], "report rate"),
        (["step", "hume", "--joint", "left_knee", "--amplitude", "900Nm"], "torque_limit"),
        (["step", "vlca", "--table", "7.1"], "of Hume's joints"),
        (["step", "vlca", "--law", "all"], "one"),
        ([], "--can"),
    ],
)
def test_a_mistake_gets_one_sentence(capsys, arguments, part):
    assert part in complaint(capsys, *arguments)
