"""Several runs in one page: what differs, their numbers side by side, their signals drawn over each other."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hil.analysis.comparison import NumberRow, SideBySide
from hil.analysis.derived import Derived
from hil.record.recorded import Recorded
from hil.report.drawing import LIMIT, draw_line, encoded, new_figure
from hil.report.html import Link, document, film, picture, run_link

_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:brown", "tab:cyan", "tab:olive", "tab:pink")
_STYLES = ("-", "--", "-.")  # where the colours have been used up
_FIRST = 5  # differences that are told
_NEAR = 2.5  # times the data: limits further away are only named
_MARK: dict[str, Any] = {"marker": "x", "markersize": 7, "markeredgewidth": 2.0, "linestyle": "none"}


def write_comparison(directory: Path, found: SideBySide, pictures: bool = False, part_of: Link | None = None) -> Path:
    """Write ``compare.html`` into ``directory``, which is created; returns its path.

    ``pictures``: every plot as a PNG file, too. ``part_of``: the page that it belongs to.
    """
    directory.mkdir(parents=True, exist_ok=True)
    shown = []
    for name, title, caption, figure in _Overlay(found).figures():
        if pictures:
            figure.savefig(directory / f"{name}.png", dpi=150)
        shown.append(picture(title, caption, encoded(figure)))
    body = f"""{_runs(directory, found)}
<h2>What differs</h2>{_differing(found)}{_parting(found)}
<h2>Key numbers</h2><p class=caption>In brackets: less that of A. Red: beyond the run's own limit.</p>{_numbers(found)}
{_films(directory, found)}{"".join(shown)}"""
    path = directory / "compare.html"
    title = f"{', '.join(found.letters[:-1])} beside {found.letters[-1]}" if len(found.runs) < 6 else "Runs compared"
    path.write_text(document(title, body, part_of), encoding="utf-8")
    return path


def _table(head: Iterable[str], rows: Iterable[Iterable[tuple[str, str]]]) -> str:
    """Cells as (attributes, HTML)."""
    lines = "".join("<tr>" + "".join(f"<td{kind}>{cell}</td>" for kind, cell in row) + "</tr>" for row in rows)
    heads = "".join(f"<th>{html.escape(name)}" for name in head)
    return f"<div class=wide><table><tr>{heads}</tr>{lines}</table></div>"


def _runs(directory: Path, found: SideBySide) -> str:
    rows = []
    for index, run in enumerate(found.runs):
        swatch = f'<b style="color:{_colour(index)}">{found.letters[index]}</b>'
        link = run_link(directory, run.directory, run.directory.name)
        cells = [swatch, link, html.escape(run.scenario.name), str(run.seed), f"{run.end:.2f} s"]
        rows.append([*(("", cell) for cell in cells), (" class=text", f"{run.verdict}: {html.escape(run.reason)}")])
    return _table(("", "run", "scenario", "seed", "simulated", "verdict"), rows)


def _differing(found: SideBySide) -> str:
    if not found.differing:
        return "<p>nothing: these are repetitions of one run</p>"
    rows = [
        [("", html.escape(key)), *((" class=text", html.escape(value or "–")) for value in values)]
        for key, values in found.differing.items()
    ]
    return _table(("key", *found.letters), rows)


def _parting(found: SideBySide) -> str:
    """Where two runs part first, and the way that it takes through the nodes; nothing for more of them."""
    parting = found.parting
    if parting is None:
        return ""
    if parting.first is None:
        return f"<p>The same to the bit up to {parting.until_ns * 1e-9:.3f} s, as far as both go.</p>"
    rest = parting.differences[1:]
    items = "".join(f"<li>{html.escape(str(difference))}</li>" for difference in parting.differences[:_FIRST])
    more = f"<p class=caption>and {len(rest) + 1 - _FIRST} more: hil diff</p>" if len(rest) >= _FIRST else ""
    return f"<h2>Where they part</h2><ol>{items}</ol>{more}"


def _numbers(found: SideBySide) -> str:
    return _table(
        ("", "unit", *found.letters, "limit of A"),
        [[("", html.escape(row.name)), ("", row.unit), *_cells(row), ("", _bound(row))] for row in found.rows],
    )


def _bound(row: NumberRow) -> str:
    first = row.numbers[0]
    return "" if first is None or first.limit is None else f"{first.limit * first.scale:.4g}"


def _cells(row: NumberRow) -> Iterator[tuple[str, str]]:
    for index, (number, difference) in enumerate(zip(row.numbers, row.differences, strict=True)):
        kind = ' class="n beyond"' if number is not None and number.beyond else " class=n"
        text = "–" if number is None else number.shown
        yield kind, text if index == 0 or difference is None else f"{text} ({signed(difference)})"


def signed(difference: float) -> str:
    """A difference with its sign, four digits; a plain 0 for none."""
    return "0" if difference == 0.0 else f"{difference:+.4g}"


def _films(directory: Path, found: SideBySide) -> str:
    films = [
        f"<p>{html.escape(found.label(index))}</p>{film(directory, run.directory)}"
        for index, run in enumerate(found.runs)
        if film(directory, run.directory)
    ]
    return f"<h2>Videos</h2>{''.join(films)}" if films else ""


def _colour(index: int) -> str:
    from matplotlib.colors import to_hex

    return to_hex(_COLOURS[index % len(_COLOURS)])


class _Overlay:
    """The figures. What a run does not have is left out of it."""

    def __init__(self, found: SideBySide) -> None:
        self.found = found
        self.runs = [(run, Derived(run.tables, run.scenario.terrain, run.scenario.limits.settle)) for run in found.runs]
        self.end = max((run.end for run in found.runs), default=0.0) or 1.0

    def figures(self) -> Iterator[tuple[str, str, str, Any]]:
        """Name of a file, title, caption, figure."""
        yield (
            "com-error",
            "Centre of mass",
            ("Distance of the true CoM from its reference in the sagittal plane. A cross: there a run failed."),
            self._com(),
        )
        yield (
            "internal-force",
            "Internal force between the feet",
            ("Sensed, from spring torques; black: the reference of A."),
            self._force(),
        )
        yield "torso", "Torso", "True roll and pitch, less their references.", self._torso()
        yield (
            "torques",
            "Joint torques",
            "Sensed at the joint. The drives' limits are drawn where they are near.",
            self._torques(),
        )
        yield "friction", "Use of friction", "Tangential over normal force, the larger of the feet's.", self._friction()
        yield (
            "buses",
            "Buses",
            ("Left: load of the fullest bus. Right: from a sample to the command computed from it, slowest joint."),
            self._buses(),
        )

    @cached_property
    def looks(self) -> list[dict[str, Any]]:
        count = len(_COLOURS)
        return [
            {"color": _COLOURS[n % count], "linestyle": _STYLES[n // count % len(_STYLES)], "alpha": 0.85}
            for n in range(len(self.runs))
        ]

    def _curves(
        self, axes: Any, ylabel: str, signal: Callable[[Recorded, Derived], tuple[np.ndarray, np.ndarray] | None]
    ) -> None:
        """Draw ``signal`` of every run over time, scaled by what comes after settling; dress the axes."""
        settle = max(run.scenario.limits.settle for run, _ in self.runs)
        late = [np.empty(0)]
        for index, (run, derived) in enumerate(self.runs):
            pair = signal(run, derived) if len(derived.world) and len(derived.controller) else None
            if pair is None or not np.isfinite(pair[1]).any():
                continue
            times, values = pair
            draw_line(axes, times, values, **self.looks[index])
            late.append(values[(times >= run.scenario.limits.settle) & np.isfinite(values)])
            if run.verdict == "unstable":
                last = np.flatnonzero(np.isfinite(values))[-1]
                axes.plot(times[last], values[last], color=self.looks[index]["color"], clip_on=False, **_MARK)
        axes.set(xlabel="t [s]", ylabel=ylabel, xlim=(0.0, self.end))
        shown = np.concatenate(late)
        if len(shown):
            room = 0.1 * (np.ptp(shown) or abs(shown[0]) or 1.0)
            axes.set_ylim(shown.min() - room, shown.max() + room)
        axes.axvspan(0.0, min(settle, self.end), color="0.93", zorder=0)

    def _legend(self, figure: Any) -> Any:
        from matplotlib.lines import Line2D

        handles = [Line2D([], [], **look) for look in self.looks]
        labels = [self.found.label(n) for n in range(len(self.runs))]
        figure.legend(handles, labels, loc="outside lower center", fontsize=8, ncols=2 if len(labels) > 2 else 1)
        return figure

    def _limits(self, axes: Any, values: Sequence[float], label: str) -> None:
        """Limits of all runs: one line if they are equal."""
        for value in dict.fromkeys(values):
            _limit(axes, value, label)
        axes.legend(fontsize=8, loc="upper right")

    def _com(self) -> Any:
        figure, axes = new_figure(height=3.6)
        self._curves(axes, "CoM error [mm]", lambda _, d: (d.controller.seconds, 1e3 * d.com_distance))
        axes.set_ylim(bottom=0.0)
        self._limits(axes, [1e3 * run.scenario.limits.com_error for run, _ in self.runs], "limit")
        return self._legend(figure)

    def _force(self) -> Any:
        figure, axes = new_figure(height=3.6)

        def settled(_: Recorded, derived: Derived) -> tuple[np.ndarray, np.ndarray] | None:
            late = derived.settled(derived.controller)
            if "internal_force" not in derived.controller or not late.any():
                return None
            return derived.controller.seconds[late], derived.controller["internal_force"][late]

        self._curves(axes, "internal force [N]", settled)
        first = self.runs[0][1].controller
        if "internal_force_reference" in first:
            axes.plot(first.seconds, first["internal_force_reference"], "k--", linewidth=1.0)
        return self._legend(figure)

    def _torso(self) -> Any:
        figure, both = new_figure(1, 2, height=3.6)
        for column, (axes, name) in enumerate(zip(both, ("roll", "pitch"), strict=True)):

            def error(_: Recorded, derived: Derived, column: int = column) -> tuple[np.ndarray, np.ndarray]:
                return derived.controller.seconds, np.degrees(derived.orientation_error[:, column])

            self._curves(axes, f"{name} error [°]", error)
            limits = [np.degrees(run.scenario.limits.orientation_error) for run, _ in self.runs]
            self._limits(axes, limits, "limit ±")
        return self._legend(figure)

    def _torques(self) -> Any:
        names = dict.fromkeys(j for _, d in self.runs for j in d.controller.members("torque_sensed"))
        rows = max(-(-len(names) // 3), 1)
        figure, grid = new_figure(rows, 3, height=0.8 + 2.4 * rows)
        for axes, joint in zip(np.ravel(grid), names, strict=False):

            def torque(_: Recorded, derived: Derived, joint: str = joint) -> tuple[np.ndarray, np.ndarray] | None:
                table, signal = derived.controller, f"torque_sensed.{joint}"
                return (table.seconds, table[signal]) if signal in table else None

            self._curves(axes, "torque [N m]", torque)
            axes.set_title(joint.replace("_", " "), fontsize=10)
            for limit in dict.fromkeys(run.scenario.firmware.torque_limit for run, _ in self.runs):
                _limit(axes, limit, "")
                _limit(axes, -limit, "")
        return self._legend(figure)

    def _friction(self) -> Any:
        figure, axes = new_figure(height=3.6)
        top = 1.4 * max(0.1, *(run.scenario.terrain.friction for run, _ in self.runs))

        def used(_: Recorded, derived: Derived) -> tuple[np.ndarray, np.ndarray] | None:
            ratios = [np.nan_to_num(ratio, nan=-1.0) for ratio in derived.friction_ratio.values()]
            if not ratios:
                return None
            largest = np.max(ratios, axis=0)
            largest = np.minimum(largest, top)  # of a foot that hardly touches the ground it is anything
            return derived.world.seconds, np.where(largest >= 0.0, largest, np.nan)

        self._curves(axes, "tangential / normal force", used)
        for value in dict.fromkeys(run.scenario.terrain.friction for run, _ in self.runs):
            axes.axhline(value, **LIMIT, label=f"friction coefficient {value:g}")
        axes.set_ylim(0.0, top)
        axes.legend(fontsize=8, loc="upper right")
        return self._legend(figure)

    def _buses(self) -> Any:
        figure, (load, trip) = new_figure(1, 2, height=3.6)

        def fullest(_: Recorded, derived: Derived) -> tuple[np.ndarray, np.ndarray] | None:
            loads = derived.bus.group("load")
            return (derived.bus.seconds, 100 * loads.max(axis=1)) if loads.size else None

        def slowest(_: Recorded, derived: Derived) -> tuple[np.ndarray, np.ndarray] | None:
            trips = 1e3 * derived.drives.group("round_trip")
            worst = np.where(np.isfinite(trips), trips, -np.inf).max(axis=1, initial=-np.inf)
            shown = np.isfinite(worst)
            return (derived.drives.seconds[shown], worst[shown]) if shown.any() else None

        self._curves(load, "bus load [%]", fullest)
        load.set_ylim(0, 115)
        self._limits(load, [100.0], "capacity")
        self._curves(trip, "round trip [ms]", slowest)
        self._limits(trip, [1e3 / run.scenario.controller.rate for run, _ in self.runs], "servo period")
        trip.set_ylim(bottom=0.0)
        return self._legend(figure)


def _limit(axes: Any, value: float, label: str) -> None:
    """A limit as a line, if it is near what is shown; else it is only named."""
    low, high = axes.get_ylim()
    text = f"{label} {value:.3g}" if label else None
    if abs(value) <= _NEAR * max(abs(low), abs(high)):
        axes.axhline(value, **LIMIT, label=text)
        axes.set_ylim(min(low, 1.1 * value), max(high, 1.1 * value))
    elif label:
        axes.plot([], [], **LIMIT, label=f"{text}, beyond the axis")
