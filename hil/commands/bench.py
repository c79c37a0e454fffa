"""``hil bench``: where the time goes, on this machine, now. Targets stand beside the measured numbers."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from typing import Any

from hil.estimator_lab import cost
from hil.run import Request, assemble, run
from hil.scenario import Scenario, load

SCENARIO = "split-terrain"
STEPPING = "balance"
TARGETS = {
    "realtime_factor.processes": ("≥", 1.0),
    "realtime_factor.inline": ("≥", 4.0),
    "realtime_factor.balance": ("≥", 2.0),  # stepping, inline
    "per_cpu_second.balance": ("≥", 2.0),  # the same where nothing else runs
    "controller_tick_us": ("≤", 60.0),
    "estimators_us": ("≤", 1e6 * cost.LIMIT),
    "plan_us": ("≤", 1000.0),
    "start_up_s": ("≤", 3.0),
    "memory_gb": ("≤", 1.5),
}


class Timed:
    """A proxy that adds up the time spent in the methods of what it stands for."""

    def __init__(self, inner: Any, label: str, spent: dict[str, int]) -> None:
        self._inner, self._label, self._spent = inner, label, spent

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._inner, name)
        if not callable(value):
            return value
        label = f"{self._label}.{name}"
        spent, clock = self._spent, time.perf_counter_ns

        def timed(*args: Any) -> Any:
            began = clock()
            result = value(*args)
            spent[label] += clock() - began
            return result

        setattr(self, name, timed)  # next time without the look-up
        return timed


def shares(backend: str, duration: float) -> dict[str, float]:
    """Share of the launcher's time by part, in one instrumented run (the proxies slow it by some per cent)."""
    spent: dict[str, int] = defaultdict(int)

    def wrap(label: str, node: Any) -> Any:
        # wires have attributes that the calendar reads at every event: a proxy there would measure itself
        return node if label == "bus" else Timed(node, label, spent)

    with assemble(Request(load(SCENARIO), seed=1, backend=backend), wrap) as assembly:
        system = assembly.system
        for b, wire in enumerate(system.wires):
            wire.advance = _timed(wire.advance, "bus", spent)
            wire.offer = _timed(wire.offer, "bus", spent)
            system.wires[b] = wire
        began = time.perf_counter_ns()
        system.run_until(round(duration * 1e9))
        total = time.perf_counter_ns() - began
    inline = backend == "inline"
    labels = {
        "physics.": "physics",
        "bus": "bus",
        "recorder.": "recorder",
        "firmware.": "firmware" if inline else "waking and waiting for the joints",
        "controller.start": "controller" if inline else "Zenoh: sending",
        "controller.": "controller" if inline else "waiting for Zenoh and the controller",
    }
    result: dict[str, float] = defaultdict(float)
    for label, nanoseconds in spent.items():
        part = next(name for prefix, name in labels.items() if label.startswith(prefix))
        result[part] += nanoseconds / total
    result["calendar, gateway, links"] = 1.0 - sum(result.values())
    return dict(result)


def _timed(function: Any, label: str, spent: dict[str, int]) -> Any:
    clock = time.perf_counter_ns

    def timed(*args: Any) -> Any:
        began = clock()
        result = function(*args)
        spent[label] += clock() - began
        return result

    return timed


def per_cpu_second(scenario: Scenario) -> float:
    """Simulated seconds per second of processor time, inline: what other work on the machine changes least."""
    with assemble(Request(scenario, backend="inline")) as assembly:
        began = time.process_time()
        assembly.system.run_until(round(scenario.duration * 1e9))
        return assembly.system.now_ns * 1e-9 / (time.process_time() - began)


def controller_tick_us(ticks: int = 3000) -> float:
    """Median time of the controller's tick with its model update, in a closed loop, µs."""
    samples: list[int] = []

    def wrap(label: str, node: Any) -> Any:
        if label == "controller":
            inner = node._controller
            tick = inner.tick

            def timed(now_ns: int) -> Any:
                began = time.perf_counter_ns()
                result = tick(now_ns)
                samples.append(time.perf_counter_ns() - began)
                return result

            inner.tick = timed
        return node

    scenario = load(SCENARIO)
    with assemble(Request(scenario, seed=1, backend="inline"), wrap) as assembly:
        assembly.system.run_until(round(ticks / scenario.controller.rate * 1e9))
    return statistics.median(samples[len(samples) // 2 :]) * 1e-3


def plan_us(plans: int = 300) -> float:
    """Median time of planning one foot by shooting, up onto a platform of 7 cm, µs."""
    from central_controller.planning.config import PlannerConfig
    from central_controller.planning.height_surface import platform
    from central_controller.planning.pendulum import Foot, Pendulum, PendulumState
    from central_controller.planning.reach import LEFT
    from central_controller.planning.velocity_reversal import VelocityReversalPlanner

    planner = VelocityReversalPlanner(PlannerConfig(), Pendulum(platform(0.86, 0.07, 0.2, 0.9, 0.3)))
    samples = []
    for n in range(plans):
        state = PendulumState(-0.1 + 0.4 * n / plans, -0.05, 0.3, 0.25)
        began = time.perf_counter_ns()
        planner.plan(state, Foot(0.0, -0.1), LEFT, 0.2, (0.0, 0.0))
        samples.append(time.perf_counter_ns() - began)
    return statistics.median(samples) * 1e-3


def start_up(repeats: int = 3) -> float:
    """Median seconds from the command to the first tick, warm caches."""
    times = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as directory:
            launch = [sys.executable, "-m", "hil", "run", SCENARIO]
            command = [*launch, "--duration", "0.05s", "--json", "--out", directory]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            times.append(json.loads(result.stdout)["start_up_time"])
    return statistics.median(times)


def bench(duration: float, as_json: bool) -> int:
    """Run all measurements and print them. Returns the exit status."""
    scenario = load(SCENARIO).model_copy(update={"duration": duration})
    results: dict[str, Any] = {}
    for backend in ("processes", "inline"):
        outcome = run(Request(scenario, seed=1, backend=backend, report=False))
        results[f"realtime_factor.{backend}"] = outcome.record["realtime_factor"]
        if backend == "processes":
            results["memory_gb"] = outcome.record["memory_bytes"]["sum"] / 1e9
    stepping = load(STEPPING, [f"duration={duration:g}s"])
    outcome = run(Request(stepping, backend="inline", report=False))
    results["realtime_factor.balance"] = outcome.record["realtime_factor"]
    results["per_cpu_second.balance"] = per_cpu_second(stepping)
    results["controller_tick_us"] = controller_tick_us()
    results["estimators_us"] = 1e6 * sum(cost.tick_costs().values())  # of a tick that runs all of them
    results["plan_us"] = plan_us()
    results["start_up_s"] = start_up()
    results["shares"] = {backend: shares(backend, min(duration, 3.0)) for backend in ("processes", "inline")}
    if as_json:
        print(json.dumps(results))
        return 0
    print(f"{SCENARIO}, {duration:g} s simulated, firmware 3 kHz, control 1.5 kHz")
    for key, (sign, target) in TARGETS.items():
        met = results[key] >= target if sign == "≥" else results[key] <= target
        print(f"  {key:28} {results[key]:8.2f}   aim {sign} {target:g}: {'met' if met else 'missed'}")
    for backend, parts in results["shares"].items():
        print(f"  share of the launcher's time, {backend}:")
        for part, share in sorted(parts.items(), key=lambda item: -item[1]):
            print(f"    {part:38} {100 * share:5.1f} %")
    return 0
