"""``hil joint onboard``: a hydraulic joint's force loop on board its drive, and the same loop at the end of its bus."""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from hil.commands.joint_lab_arguments import add_arguments, directory, quantity, setup_of
from hil.errors import EmulationError, UserError

if TYPE_CHECKING:
    from hil.joint_lab.onboard import Exercise, Loop, Tracking

# Rotella 2018 §II.1: 5 kHz on board, 1 kHz off board. Nothing but the law may slow the valve's commands.
_RATE, _PHYSICS = "5kHz", "world.rate=25kHz"
_DEFAULTS = ("firmware.report_rate=1kHz", "firmware.law=valve", "firmware.torque_rate=1000000Nm/s")


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "onboard", help="a hydraulic joint's force loop on board at 5 kHz against off board at 1 kHz",
        description="Close the force loop of a hydraulic joint in its drive, and in the master at the other end of the "
        "bus, with the same law tuned by the same rule: tracking of a sine and response to a step, from the bus's log "
        "(Rotella 2018 Fig. II.2).",
    )  # fmt: skip
    add_arguments(parser)
    parser.add_argument("--amplitude", default="20Nm", metavar="NM", help="of sine and step (20Nm)")
    parser.add_argument("--frequency", default="2Hz", metavar="HZ", help="of the sine (2Hz)")
    parser.set_defaults(command=_onboard)


def _onboard(options: argparse.Namespace) -> int:
    from hil.joint_lab import onboard, plots
    from robots.actuators import Hydraulic

    options.settings = [*_DEFAULTS, *([] if options.rate else [_PHYSICS]), *options.settings]
    options.rate = options.rate or _RATE
    setup, out = setup_of(options), directory(options.out)
    if not isinstance(setup.joint.actuator, Hydraulic):
        raise UserError(f"{setup.robot.name} {setup.joint.name} is not hydraulic: it has no valve; `valve` is")
    amplitude, frequency = (
        quantity(options, "amplitude", "--amplitude", "N m"), quantity(options, "frequency", "--frequency", "Hz")
    )  # fmt: skip
    if not 0 < amplitude <= setup.firmware.torque_limit:
        raise UserError(
            f"--amplitude {options.amplitude}: expected more than 0 and at most firmware.torque_limit, "
            f"{setup.firmware.torque_limit:g} N m"
        )
    if not 0.1 <= frequency <= 100:
        raise UserError(f"--frequency {options.frequency}: expected 0.1 Hz to 100 Hz")
    exercise = onboard.Exercise(amplitude, frequency)
    loops = {"on board": onboard.on_board(setup), "off board": onboard.off_board(setup)}
    found: dict[str, Tracking] = {}
    rows: dict[str, dict[str, Any]] = {}
    for label, loop in loops.items():
        where = None if out is None else out / label.replace(" ", "-")
        try:
            found[label] = onboard.follow(setup, loop, label == "on board", exercise, where)
        except EmulationError as error:
            raise EmulationError(f"{label}: {error}") from None
        rows[label] = _row(loop, found[label], exercise)
    if out is not None:
        load = options.load.partition(",")[0]
        title = f"{setup.robot.name} {setup.joint.name}, load {load}: the force loop on board and off board"
        named = {f"{label}, {loop.rate / 1e3:g} kHz": found[label] for label, loop in loops.items()}
        plots.tracking(named, exercise, title, out / "tracking.png")
    if options.json:
        print(json.dumps(rows, allow_nan=False))
    else:
        what = f"{amplitude:g} N m, sine of {frequency:g} Hz"
        print(f"{setup.robot.name} {setup.joint.name}, load {options.load}: {what}")
        _print(rows)
    return 0


def _row(loop: Loop, tracking: Tracking, exercise: Exercise) -> dict[str, Any]:
    sine, step = tracking.sine(exercise), tracking.step(exercise)
    return {
        "rate_hz": loop.rate, "delay_s": loop.delay, "kp": loop.gains.kp, "ki": loop.gains.ki,
        "crossover_hz": loop.crossover.omega / (2.0 * math.pi),
        "phase_margin_deg": math.degrees(loop.crossover.phase_margin),
        "gain_margin_db": 20.0 * math.log10(loop.gain_margin),
        "rms_error_nm": sine.rms_error, "largest_error_nm": sine.largest_error,
        "rise_time_s": step.rise_time, "overshoot": step.overshoot, "steady_error_nm": step.steady_error,
    }  # fmt: skip


def _print(rows: dict[str, dict[str, Any]]) -> None:
    print(
        f"{'':10} {'rate':>7} {'delay':>7} {'kp':>6} {'ki':>7} {'crossover':>9} {'phase':>6} {'gain':>7}   "
        f"{'sine: rms':>10} {'largest':>9}   {'step: rise':>10} {'overshoot':>9}"
    )
    for label, row in rows.items():
        rise = "–" if row["rise_time_s"] is None else f"{1e3 * row['rise_time_s']:.1f} ms"
        print(
            f"{label:10} {1e-3 * row['rate_hz']:3.0f} kHz {1e3 * row['delay_s']:4.1f} ms {row['kp']:6.3f} "
            f"{row['ki']:5.1f}/s {row['crossover_hz']:6.1f} Hz {row['phase_margin_deg']:5.1f}° "
            f"{row['gain_margin_db']:4.1f} dB   {row['rms_error_nm']:6.2f} N m {row['largest_error_nm']:5.2f} N m   "
            f"{rise:>10} {100 * row['overshoot']:7.1f} %"
        )
