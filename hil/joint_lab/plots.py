"""The laboratory's plots: units on every axis, margins and limits drawn in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hil.joint_lab.chirp import COHERENT, Chirp
from hil.joint_lab.margins import Margins, Response, critical, frequencies
from hil.joint_lab.onboard import Exercise, Tracking
from hil.joint_lab.step import StepResponse

_LIMIT: dict[str, Any] = {"color": "tab:red", "linestyle": ":", "linewidth": 1.2}
_TWO_PI = 2.0 * math.pi


class Curve(NamedTuple):
    """A loop to be drawn, with its margins, between two angular frequencies (rad/s)."""

    loop: Response
    margins: Margins
    low: float
    high: float


def bode(curves: Mapping[str, Curve], title: str, path: Path) -> None:
    """Bode plot of open loops, the crossover that counts marked with its phase margin."""
    figure, (size, phase) = _figure(2, 1, height=6.2, sharex=True)
    for label, curve in curves.items():
        omega = frequencies(curve.low, 0.9 * curve.high)  # at a sampled loop's very end the phase jumps
        values = curve.loop(omega)
        hertz = omega / _TWO_PI
        (line,) = size.loglog(hertz, np.abs(values), linewidth=1.2)
        degrees = np.degrees(np.unwrap(np.angle(values)))
        # unwrapped from the low end, whose phase may come out a turn off
        degrees -= 360.0 * round((degrees[0] + 90.0) / 360.0)
        crossover = curve.margins.critical
        text = label
        if crossover is not None:
            at = crossover.omega / _TWO_PI
            margin = math.degrees(crossover.phase_margin)
            text = f"{label}: {margin:.1f}° at {at:.1f} Hz"
            size.plot(at, 1.0, "o", color=line.get_color(), markersize=5)
            foot = float(np.interp(at, hertz, degrees))
            phase.plot([at, at], [foot - margin, foot], color=line.get_color(), linewidth=2.5, alpha=0.5)
            phase.plot(at, foot, "o", color=line.get_color(), markersize=5)
        phase.semilogx(hertz, degrees, linewidth=1.2, color=line.get_color(), label=text)
    size.axhline(1.0, **_LIMIT)
    size.set(ylabel="|L|", xlim=(0.1, 2000.0), ylim=(1e-3, 1e4))
    phase.axhline(-180.0, **_LIMIT)
    phase.set(xlabel="frequency [Hz]", ylabel="phase of L [°]", ylim=(-400.0, 10.0), yticks=range(-360, 1, 90))
    phase.legend(fontsize=8, loc="lower left", title="phase margin", title_fontsize=8)
    figure.suptitle(title)
    _save(figure, path)


def nyquist(curves: Mapping[str, Curve], title: str, path: Path) -> None:
    """Nyquist plot of open loops around −1, with the unit circle."""
    figure, axes = _figure(1, 1, height=6.2, width=6.4)
    circle = np.exp(1j * np.linspace(0.0, _TWO_PI, 361))
    axes.plot(circle.real, circle.imag, **_LIMIT)
    for label, curve in curves.items():
        values = curve.loop(frequencies(curve.low, curve.high))
        (line,) = axes.plot(values.real, values.imag, linewidth=1.2, label=label)
        crossover = curve.margins.critical
        if crossover is not None:
            at = curve.loop(np.array([crossover.omega]))[0]
            axes.plot(at.real, at.imag, "o", color=line.get_color(), markersize=5)
            axes.plot([0, at.real], [0, at.imag], color=line.get_color(), linewidth=0.8, linestyle="--")
    axes.plot(-1.0, 0.0, "x", color="tab:red", markersize=9, markeredgewidth=2, label="−1")
    axes.set(xlabel="Re L", ylabel="Im L", xlim=(-3.0, 1.5), ylim=(-3.0, 1.5), aspect="equal")
    axes.legend(fontsize=8, loc="upper left")
    figure.suptitle(title)
    _save(figure, path)


def responses(chirps: Mapping[str, Chirp], title: str, path: Path) -> None:
    """Torque sensed over torque commanded: dots as measured where coherent, lines as predicted (Kim 2018 Fig. 5.12)."""
    figure, (size, phase, coherence) = _figure(3, 1, height=8.0, sharex=True, height_ratios=(3, 3, 1))
    for label, chirp in chirps.items():
        torque = chirp.torque
        hertz, sure = torque.measured.omega / _TWO_PI, torque.coherent
        (line,) = size.loglog(hertz, np.abs(torque.predicted), linewidth=1.2, label=label)
        dots = {"marker": ".", "linestyle": "none", "markersize": 4, "color": line.get_color()}
        size.plot(hertz[sure], np.abs(torque.measured.values)[sure], **dots)
        predicted = np.unwrap(np.angle(torque.predicted))
        phase.semilogx(hertz, np.degrees(predicted), linewidth=1.2, color=line.get_color())
        deviation = np.angle(torque.measured.values / torque.predicted)
        phase.plot(hertz[sure], np.degrees(predicted + deviation)[sure], **dots)
        coherence.semilogx(hertz, torque.measured.coherence, linewidth=1.0, color=line.get_color())
    coherence.axhline(COHERENT, **_LIMIT)
    size.set(ylabel="torque sensed / commanded")
    size.legend(fontsize=8, loc="lower left", title="lines: theory, dots: through the bus", title_fontsize=8)
    phase.set(ylabel="phase [°]")
    coherence.set(xlabel="frequency [Hz]", ylabel="coherence", ylim=(0.0, 1.05))
    figure.suptitle(title)
    _save(figure, path)


def measured_loops(chirps: Mapping[str, Chirp], title: str, path: Path) -> None:
    """Open loops as they follow from commands and currents on the bus, over theory."""
    figure, (size, phase) = _figure(2, 1, height=6.2, sharex=True)
    for label, chirp in chirps.items():
        loop = chirp.loop
        hertz, sure = loop.measured.omega / _TWO_PI, loop.coherent & (np.abs(loop.predicted) > 0.03)
        (line,) = size.loglog(hertz, np.abs(loop.predicted), linewidth=1.2)
        dots = {"marker": ".", "linestyle": "none", "markersize": 4, "color": line.get_color()}
        size.plot(hertz[sure], np.abs(loop.measured.values)[sure], **dots)
        at = critical(chirp.crossovers)
        predicted = np.unwrap(np.angle(loop.predicted))
        predicted -= _TWO_PI * round((predicted[0] + math.pi / 2) / _TWO_PI)
        text = label if at is None else f"{label}: {math.degrees(at.phase_margin):.1f}°"
        phase.semilogx(hertz, np.degrees(predicted), linewidth=1.2, color=line.get_color(), label=text)
        deviation = np.angle(loop.measured.values / loop.predicted)
        phase.plot(hertz[sure], np.degrees(predicted + deviation)[sure], **dots)
    size.axhline(1.0, **_LIMIT)
    size.set(ylabel="|L|")
    phase.axhline(-180.0, **_LIMIT)
    phase.set(xlabel="frequency [Hz]", ylabel="phase of L [°]")
    phase.legend(fontsize=8, loc="best", title="phase margin as measured", title_fontsize=8)
    figure.suptitle(title)
    _save(figure, path)


class StepLabel(NamedTuple):
    """Of a step response: whose gains, which set, and whether there was dry friction."""

    gains: str
    which: str
    friction: bool


def steps(responses: Mapping[StepLabel, StepResponse], title: str, path: Path) -> None:
    """Torque sensed over time, one panel per origin of the gains, with the target and a band of five percent."""
    origins = list(dict.fromkeys(label.gains for label in responses))
    figure, panels = _figure(1, len(origins), height=4.0, width=4.0 * max(len(origins), 2), sharey=True)
    for axes, origin in zip(np.ravel(panels), origins, strict=True):
        of_origin = {label: response for label, response in responses.items() if label.gains == origin}
        for label, response in of_origin.items():
            style: dict[str, Any] = {
                "color": "tab:blue" if label.which == "stance" else "tab:orange",
                "linestyle": "-" if label.friction else "--",
                "label": f"{label.which}, {'with' if label.friction else 'without'} friction",
            }
            axes.plot(1e3 * response.seconds, response.torque, linewidth=1.1, **style)
        target = next(iter(of_origin.values())).target
        axes.axhline(target, color="k", linewidth=0.8)
        for share in (0.95, 1.05):
            axes.axhline(share * target, **_LIMIT)
        axes.set(xlabel="t [ms]", title=origin if origin == "firmware" else f"Table {origin}")
        axes.legend(fontsize=8, loc="lower right")
    np.ravel(panels)[0].set(ylabel="torque [N m]")
    figure.suptitle(title)
    _save(figure, path)


def tracking(found: Mapping[str, Tracking], exercise: Exercise, title: str, path: Path) -> None:
    """Torque commanded and sensed: a sine, its error, and a step (Rotella 2018 Fig. II.2)."""
    figure, (torque, error, step) = _figure(3, 1, height=9.0, height_ratios=(3, 2, 3))
    above: dict[str, Any] = {"fontsize": 8, "loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "ncols": 3}
    for label, of in found.items():
        sine, response = of.sine(exercise), of.step(exercise)
        time = sine.seconds - exercise.settle
        torque.plot(time, sine.sensed, linewidth=1.1, label=f"{label}, sensed")
        error.plot(time, sine.sensed - sine.commanded, linewidth=1.0, label=f"{label}: {sine.rms_error:.2f} N m rms")
        step.plot(1e3 * response.seconds, response.torque, linewidth=1.1, marker=".", markersize=3, label=label)
    torque.plot(time, sine.commanded, "k--", linewidth=1.0, label="commanded")
    torque.set(ylabel="torque [N m]")
    torque.legend(**above)
    error.axhline(0.0, color="k", linewidth=0.6)
    error.set(xlabel="t [s]", ylabel="error [N m]")
    error.legend(**above)
    step.step([-20.0, 0.0, 60.0], [0.0, exercise.amplitude, exercise.amplitude], "k--", where="post", linewidth=1.0)
    for share in (0.95, 1.05):
        step.axhline(share * exercise.amplitude, **_LIMIT)
    step.set(xlabel="t after the step [ms]", ylabel="torque [N m]", xlim=(-10.0, 60.0))
    step.legend(**above)
    figure.suptitle(title)
    _save(figure, path)


def _figure(rows: int, columns: int, height: float, width: float = 8.0, **options: Any) -> tuple[Any, Any]:
    figure, axes = plt.subplots(rows, columns, figsize=(width, height), layout="constrained", **options)
    for ax in np.ravel(axes):
        ax.grid(alpha=0.3, which="both")
    return figure, axes


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=120)
    plt.close(figure)
