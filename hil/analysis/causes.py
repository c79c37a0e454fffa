"""What came first before a run failed: saturation, slip, a foot without load, missed frames, a drive's fault, or an
oscillation with its frequency.

Each is a *sign*: a condition that began at some time and is not of the undisturbed run. Oscillations are looked for in
what was before anything slipped, lost contact or stopped, because that shakes everything.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import detrend, get_window

from bus.drive_faults import DriveFault
from bus.messages import Statusword
from hil.analysis.derived import Derived
from hil.record.signals import Signals
from hil.scenario import Scenario

_SATURATED_S = 0.02  # the limit of its torque's rate alone holds a drive back for 6 ms, on an undisturbed path
_SLIP_M = 0.002  # beyond where the foot was when errors began to count
_UNLOADED_S = 0.02
_MISSED_PERIODS = 3  # of the controller, without what each of them should have brought
_WINDOW_S, _HOP_S = 1.0, 0.05
_PERIODS = 3  # fewest in a window
_SHAKES = ("slip", "contact loss", "drive fault")  # after which all oscillates
_GROWTH = 3.0  # over the least amplitude so far, from which it counts as begun
_NARROW = 3.0  # over the spectrum beside it


@dataclass(frozen=True)
class Sign:
    """kind: saturation, slip, contact loss, missed frames, drive fault, or oscillation, with its frequency, Hz."""

    time: float
    kind: str
    where: str
    sentence: str
    frequency: float | None = None

    def __str__(self) -> str:
        return f"{self.time:.3f} s  {self.kind}, {self.where}: {self.sentence}"


def signs(tables: Mapping[str, Signals], scenario: Scenario) -> list[Sign]:
    """All signs of a run, the first of each kind and place, in order of time.

    Args:
        tables: channels ``controller``, ``world``, ``drives`` and ``bus`` by name.
    """
    if any(not len(tables[name]) for name in ("world", "controller", "drives")):
        return []
    run = Derived(tables, scenario.terrain, scenario.limits.settle)
    found = [*_saturation(run), *_slip(run), *_contact(run), *_missed(run, scenario), *_faults(run)]
    until = min((sign.time for sign in found if sign.kind in _SHAKES), default=np.inf)
    found += _oscillations(run, scenario, until)
    return sorted(found, key=lambda sign: sign.time)


def _first_run(times: np.ndarray, on: np.ndarray, shortest: float) -> float | None:
    """When ``on`` first began to hold for at least ``shortest``; both in s, (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if times[end - 1] - times[start] >= shortest:
            return float(times[start])
    return None


def _saturation(run: Derived) -> Iterator[Sign]:
    times, settled = run.drives.seconds, run.settled(run.drives)
    for joint in run.drives.members("statusword"):
        word = np.nan_to_num(run.drives[f"statusword.{joint}"]).astype(int)
        limited = (word & Statusword.LIMITED != 0) & settled & (word & Statusword.MASK == Statusword.OPERATION_ENABLED)
        begin = _first_run(times, limited, _SATURATED_S)
        if begin is not None:
            yield Sign(begin, "saturation", joint, "its drive gives less than is asked for")


def _slip(run: Derived) -> Iterator[Sign]:
    settled = run.settled(run.world)
    for foot, displacement in run.foot_displacement.items():
        known = np.flatnonzero(settled & np.isfinite(displacement))
        if len(known):
            beyond = settled & (np.nan_to_num(displacement - displacement[known[0]]) > _SLIP_M)
            begin = _first_run(run.world.seconds, beyond, 0.0)
            if begin is not None:
                used = run.friction_ratio[foot]
                row = int(np.searchsorted(run.world.seconds, begin))
                share = np.nanmax(used[max(0, row - 30) : row + 1], initial=0.0) / run.terrain.friction
                yield Sign(begin, "slip", foot, f"2 mm from where it stood, {100 * share:.0f} % of friction in use")


def _contact(run: Derived) -> Iterator[Sign]:
    for foot, lifted in run.lifted_time.items():
        beyond = np.flatnonzero(lifted > _UNLOADED_S)
        if len(beyond):
            begin = run.world.seconds[beyond[0]] - lifted[beyond[0]]
            yield Sign(float(begin), "contact loss", foot, f"without load for more than {1e3 * _UNLOADED_S:.0f} ms")


def _missed(run: Derived, scenario: Scenario) -> Iterator[Sign]:
    period = 1.0 / scenario.controller.rate
    settled = run.settled(run.controller)
    age = run.controller["state_age"]
    usual = np.nanmedian(age[settled]) if settled.any() else 0.0
    late = np.flatnonzero(settled & (age > usual + _MISSED_PERIODS * period))
    if len(late):
        time = run.controller.seconds[late[0]]
        began = float(time - age[late[0]])
        text = f"no state of a drive for {1e3 * age[late[0]]:.1f} ms at the controller"
        yield Sign(began, "missed frames", "states", text)
    begun = {}
    for joint in run.drives.members("round_trip"):
        missing = run.settled(run.drives) & ~np.isfinite(run.drives[f"round_trip.{joint}"])
        begun[joint] = _first_run(run.drives.seconds, missing, (_MISSED_PERIODS - 1) * period * 0.999)
    for time in sorted({time for time in begun.values() if time is not None}):
        joints = ", ".join(joint for joint in begun if begun[joint] == time)
        yield Sign(time, "missed frames", joints, f"{_MISSED_PERIODS} commands or more in a row did not come")


def _faults(run: Derived) -> Iterator[Sign]:
    stopped = (Statusword.FAULT, Statusword.FAULT_REACTION_ACTIVE, Statusword.QUICK_STOP_ACTIVE)
    for joint in run.drives.members("statusword"):
        state = np.nan_to_num(run.drives[f"statusword.{joint}"]).astype(int) & Statusword.MASK
        rows = np.flatnonzero(np.isin(state, stopped) & run.settled(run.drives))
        if len(rows):
            number = int(run.drives[f"error.{joint}"][rows[0]])
            name = DriveFault(number).name if number in set(DriveFault) else f"fault {number}"
            yield Sign(float(run.drives.seconds[rows[0]]), "drive fault", joint, name.lower().replace("_", " "))


def _oscillations(run: Derived, scenario: Scenario, until: float) -> Iterator[Sign]:
    table = run.controller
    rows = run.settled(table) & (table.seconds < until)
    limits = scenario.limits
    com, tilt = 0.1 * limits.growth_amplitude, 0.1 * limits.growth_amplitude
    force = table["internal_force"] - table["internal_force_reference"]
    asked = float(np.abs(table["internal_force_reference"]).max(initial=0.0))
    signals = {  # with the least amplitude that means anything, unit and scale for a person
        "com.x": (run.com_error[:, 0], com, "mm", 1e3),
        "com.z": (run.com_error[:, 1], com, "mm", 1e3),
        "pitch": (run.orientation_error[:, 1], tilt, "mrad", 1e3),
        "internal force": (force, max(1.0, 0.02 * asked), "N", 1.0),
    }
    for joint in table.members("torque_sensed"):
        signals[f"torque of {joint}"] = table[f"torque_sensed.{joint}"], 1.0, "N m", 1.0
    for name, (values, least, unit, scale) in signals.items():
        begun = onset(table.seconds[rows], values[rows], least)
        if begun is not None:
            time, frequency, amplitude = begun
            text = f"{frequency:.1f} Hz, {scale * amplitude:.2g} {unit} at its end"
            yield Sign(time, "oscillation", name, text, frequency)


def onset(times: np.ndarray, values: np.ndarray, least: float) -> tuple[float, float, float] | None:
    """When an oscillation began that is still there at the end: time [s], frequency [Hz] and amplitude at the end.

    A spectrum (Hann window of 1 s, every 0.05 s) is searched for a narrow peak, of three periods or more in a window,
    at the end; it began in the middle of the first window from which on its amplitude was ``_GROWTH`` times the
    smallest that it ever was, and ``least``.

    Args:
        times: (n,), s, evenly spaced.
        values: (n,).
        least: smallest amplitude that counts.

    Returns:
        None if there is none, or fewer than two windows.
    """
    if len(times) < 2:
        return None
    rate = (len(times) - 1) / (times[-1] - times[0])
    length, hop = round(_WINDOW_S * rate), max(1, round(_HOP_S * rate))
    starts = np.arange(len(times) - length, -1, -hop)[::-1]
    if len(starts) * hop < length or not np.all(np.isfinite(values)):
        return None
    window = get_window("hann", length)
    pieces = detrend(np.stack([values[start : start + length] for start in starts]), axis=1)
    amplitudes = 2.0 * np.abs(np.fft.rfft(pieces * window, axis=1)) / window.sum()  # of a sine: its amplitude
    last = amplitudes[-1]
    peak = _PERIODS + int(np.argmax(last[_PERIODS : len(last) // 2]))  # bins are one period per window apart
    beside = np.concatenate([last[max(1, peak - 6) : peak - 2], last[peak + 3 : peak + 7]])
    if last[peak] < max(least, _NARROW * float(beside.max(initial=0.0)), *last[peak - 1 : peak + 2]):
        return None
    course = amplitudes[:, peak - 1 : peak + 2].max(axis=1)
    begun = course > max(least, _GROWTH * course.min())
    if not begun[-1]:
        return None
    first = int(np.flatnonzero(~begun)[-1]) + 1 if not begun.all() else 0
    left, centre, right = np.log(last[peak - 1 : peak + 2])
    offset = 0.5 * (left - right) / (left - 2.0 * centre + right)
    return float(times[starts[first] + length // 2]), float((peak + offset) * rate / length), float(last[peak])
