"""``hil bench joint``: what one interrupt of an emulated drive costs, beside its law alone: in plain Python and as C.

The drive is enabled and follows a torque; its encoders change at every interrupt. Nothing comes over the bus.
"""

from __future__ import annotations

import ctypes
import json
import math
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bus import messages
from bus.frames import Frame
from bus.messages import Controlword, GainSet, Mode, Setpoint
from hil.compiled import compile_function, compiler
from joint_firmware.config import LAW_NAMES, FirmwareConfig
from joint_firmware.drive import DriveState
from joint_firmware.export.c99 import source_files
from joint_firmware.export.drive_law import ExportedLaw, exported_law
from joint_firmware.export.python_source import python_function
from joint_firmware.firmware import JointFirmware
from joint_firmware.laws import drive_law
from joint_firmware.memory import LawMemory
from robots import description, pins

AIM_US = 5.0
ROBOT, JOINT = "hume", "left_knee"
_SPRING_COUNTS = 297  # what the spring holds, and what is commanded: nothing is left to integrate
_PATTERN = 64  # different samples of the encoders: a stretch so short that the processor is not taken away in every one

ROWS = {
    "interrupt": "the emulated drive's whole interrupt, without bus traffic",
    "interrupt_reporting": "the same with its state on the bus at every second one",
    "law_emulated": "of it the law, compiled, through CasADi's buffer",
    "law_python": "the law in plain Python, operation by operation",
    "law_ctypes": "the exported C, called from Python by ctypes",
    "law_c": "the exported C, called from C",
}

_LOOP = """
#include "joint_law.h"
void bench_steps(joint_law *law, const int32_t *counts, int patterns, int steps);
void bench_steps(joint_law *law, const int32_t *counts, int patterns, int steps)
{
    int k;
    for (k = 0; k < steps; k++)
        joint_law_step(law, counts + (k % patterns) * JOINT_LAW_COUNTS);
}
"""


def _config(law: str) -> FirmwareConfig:
    return FirmwareConfig.model_validate({"law": law})


def _samples() -> list[tuple[int, int]]:
    """Counts of motor and joint encoder while the joint swings by 1 mrad around 1 rad."""
    joint = description.load(ROBOT).joint(JOINT)
    deflection = _SPRING_COUNTS / joint.spring_counts_per_rad
    angles = [1.0 + 1e-3 * math.sin(2.0 * math.pi * k / _PATTERN) for k in range(_PATTERN)]
    return [
        (round((angle + deflection) * joint.sensor.encoder), round(angle * joint.sensor.joint_encoder))
        for angle in angles
    ]


def _torque() -> float:
    """N m."""
    return _SPRING_COUNTS * description.load(ROBOT).joint(JOINT).sensor.torque_resolution


def _pins() -> np.ndarray:
    """Input pins of a drive that is well, int32."""
    inputs = np.zeros(pins.N_INPUTS, np.int32)
    inputs[pins.MOTOR_ENCODER], inputs[pins.JOINT_ENCODER] = _samples()[0]
    inputs[pins.SPRING_ENCODER] = _SPRING_COUNTS
    inputs[pins.SUPPLY_ADC] = description.load(ROBOT).joint(JOINT).actuator.supply_voltage / pins.VOLT_PER_COUNT
    inputs[pins.TEMPERATURE_ADC] = 25.0 / pins.KELVIN_PER_COUNT
    return inputs


def _cost_us(run: Callable[[int], None], seconds: float, empty: Callable[[int], None] | None = None) -> float:
    """µs per round of ``run(rounds)``, less that of ``empty``: of the fastest stretch of _PATTERN rounds in
    ``seconds``, as other work on the machine only ever slows it."""

    def fastest(of: Callable[[int], None]) -> float:
        best, ends = math.inf, time.monotonic() + seconds
        while time.monotonic() < ends or best == math.inf:
            began = time.perf_counter_ns()
            of(_PATTERN)
            best = min(best, time.perf_counter_ns() - began)
        return best * 1e-3 / _PATTERN

    return fastest(run) - (fastest(empty) if empty is not None else 0.0)


def _enabled_drive(config: FirmwareConfig) -> tuple[JointFirmware, Any, Any]:
    """A drive that follows a torque, its input and its output pins."""
    robot = description.load(ROBOT)
    drive = JointFirmware(robot, robot.joint_names.index(JOINT), config, compile_function)
    inputs, outputs = _pins(), np.zeros(pins.N_OUTPUTS, np.int32)
    drive.attach(inputs, outputs)
    while drive.state == DriveState.NOT_READY:
        drive.tick(0, ())
    words = (Controlword.SHUTDOWN, Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION)
    for counter, word in enumerate(words, start=1):
        slots = [Setpoint(word, Mode.TORQUE, GainSet.STANCE, _torque())] * messages.SLOTS
        drive.tick(0, (Frame(messages.COMMAND, messages.encode_command(counter, slots)),))
    assert drive.state == DriveState.OPERATION_ENABLED
    return drive, memoryview(inputs), memoryview(outputs)  # type: ignore[arg-type]


def interrupt_us(law: str, seconds: float, report_rate: float) -> float:
    """One interrupt of a drive with ``law`` that reports at ``report_rate`` [Hz], µs."""
    config = FirmwareConfig.model_validate(
        {"law": law, "report_rate": f"{report_rate:g} Hz", "watchdog": "1e6 s", "heartbeat_period": "0 s"}
    )
    drive, inputs, outputs = _enabled_drive(config)
    samples, motor, joint = _samples(), pins.MOTOR_ENCODER, pins.JOINT_ENCODER
    sensed, demanded = pins.CURRENT_ADC, pins.CURRENT_DEMAND
    tick = drive.tick

    def run(rounds: int) -> None:
        for _ in range(rounds // _PATTERN):
            for inputs[motor], inputs[joint] in samples:
                inputs[sensed] = outputs[demanded]
                tick(0, ())

    def empty(rounds: int) -> None:
        for _ in range(rounds // _PATTERN):
            for inputs[motor], inputs[joint] in samples:
                inputs[sensed] = outputs[demanded]

    cost = _cost_us(run, seconds, empty)
    assert drive.state == DriveState.OPERATION_ENABLED  # it has worked all the time
    return cost


def _input_of(law: ExportedLaw) -> list[float]:
    """u of a drive that follows a torque."""
    values = {"torque": _torque(), "limit": 500.0, "torque_mode": 1.0, **law.gains["stance"]}
    return [values.get(quantity.name, 0.0) for quantity in law.input]


def _counts(law: ExportedLaw) -> np.ndarray:
    """Samples as rows of the law's counts, int32."""
    rows = np.tile(_pins(), (_PATTERN, 1))
    rows[:, [pins.MOTOR_ENCODER, pins.JOINT_ENCODER]] = _samples()
    return rows


def law_emulated_us(law: ExportedLaw, seconds: float) -> float:
    memory = LawMemory(drive_law(description.load(ROBOT).joint(JOINT), _config(law.name)), compile_function)
    memory.p_array[:], memory.u_array[:] = law.values, _input_of(law)
    rows, evaluate = _counts(law).tolist(), memory.evaluate
    counts = memoryview(memory.counts_array)  # type: ignore[arg-type]
    x, x_next = memory.x_array, memory.x_next_array
    motor, joint = pins.MOTOR_ENCODER, pins.JOINT_ENCODER
    memory.counts_array[:] = rows[0]

    def run(rounds: int) -> None:
        for _ in range(rounds // _PATTERN):
            for row in rows:
                counts[motor], counts[joint] = row[motor], row[joint]
                evaluate()
                x[:] = x_next

    return _cost_us(run, seconds)


def law_python_us(law: ExportedLaw, seconds: float) -> float:
    step = python_function(law.program, ("counts", "x", "u", "p"), ("x_next", "y"))
    u, p = _input_of(law), law.values.tolist()
    rows = _counts(law).astype(float).tolist()
    x, x_next, y = [0.0] * len(law.state), [0.0] * len(law.state), [0.0] * len(law.outputs)

    def run(rounds: int) -> None:
        nonlocal x, x_next
        for _ in range(rounds // _PATTERN):
            for counts in rows:
                step(counts, x, u, p, x_next, y)
                x, x_next = x_next, x

    return _cost_us(run, seconds)


class LoadedLaw:
    """An export, loaded into this process.

    ``x``, ``u``, ``y`` are its memory (arrays of the export's precision).
    """

    def __init__(self, library: Path, law: ExportedLaw, joint: str, precision: str) -> None:
        real: Any = ctypes.c_double if precision == "double" else ctypes.c_float
        fields = [("x", real * len(law.state)), ("u", real * len(law.input)), ("y", real * len(law.outputs))]
        kind = type("joint_law", (ctypes.Structure,), {"_fields_": [*fields, ("p", ctypes.c_void_p)]})
        self.memory, self.code = kind(), ctypes.CDLL(str(library))
        self.x, self.u, self.y = (np.ctypeslib.as_array(getattr(self.memory, name)) for name, _ in fields)
        table = (real * len(law.values)).in_dll(self.code, joint)
        self.address = ctypes.c_void_p(ctypes.addressof(self.memory))
        self.code.joint_law_init(self.address, table)

    def step(self, counts: np.ndarray) -> None:
        """One step; ``counts`` (int32) as the law's."""
        self.code.joint_law_step(self.address, ctypes.c_void_p(counts.ctypes.data))


    def steps(self, counts: np.ndarray, number: int) -> None:
        """``number`` steps on the same ``counts``."""
        self.code.bench_steps(self.address, ctypes.c_void_p(counts.ctypes.data), 1, number)


@contextmanager
def exported(law: ExportedLaw, precision: str = "double") -> Iterator[LoadedLaw]:
    """``law`` of ROBOT's JOINT, exported, compiled and loaded. Raises OSError or subprocess.SubprocessError."""
    robot = description.load(ROBOT)
    command = (compiler() or "cc").partition(": ")[0]
    with tempfile.TemporaryDirectory() as directory:
        files = {**source_files(robot, {JOINT: law}, precision, FirmwareConfig().rate), "loop.c": _LOOP}
        for name, text in files.items():
            Path(directory, name).write_text(text, encoding="utf-8")
        sources = [name for name in files if name.endswith(".c") and name != "main.c"]
        build = [command, "-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-o", "law.so", *sources, "-lm"]
        subprocess.run(build, cwd=directory, check=True, capture_output=True)
        yield LoadedLaw(Path(directory, "law.so"), law, f"{ROBOT}_{JOINT}", precision)


def law_c_us(law: ExportedLaw, seconds: float) -> tuple[float, float]:
    """Called by ctypes, and from C."""
    with exported(law) as drive:
        drive.u[:] = _input_of(law)
        counts = _counts(law)
        addresses = [ctypes.c_void_p(row.ctypes.data) for row in counts]
        step, memory, steps = drive.code.joint_law_step, drive.address, drive.code.bench_steps

        def run(rounds: int) -> None:
            for _ in range(rounds // _PATTERN):
                for address in addresses:
                    step(memory, address)

        def loop(rounds: int) -> None:
            steps(memory, addresses[0], _PATTERN, rounds)

        return _cost_us(run, seconds), _cost_us(loop, seconds)


def measure(law: str, seconds: float) -> dict[str, Any]:
    """All rows of ROWS in µs; None for what needs a compiler, without one."""
    one = exported_law(description.load(ROBOT).joint(JOINT), _config(law))
    result: dict[str, Any] = {
        "interrupt": interrupt_us(law, seconds, report_rate=1.0),
        "interrupt_reporting": interrupt_us(law, seconds, report_rate=1500.0),
        "law_emulated": law_emulated_us(one, seconds),
        "law_python": law_python_us(one, seconds),
    }
    try:
        result["law_ctypes"], result["law_c"] = law_c_us(one, seconds)
    except (OSError, subprocess.SubprocessError):
        result["law_ctypes"] = result["law_c"] = None
    return {f"{key}_us": result[key] for key in ROWS} | {"operations": one.program.counted}


def bench_joint(seconds: float, as_json: bool) -> int:
    """Run all measurements, each for about ``seconds``, and print them. Returns the exit status."""
    results = {law: measure(law, seconds) for law in LAW_NAMES}
    if as_json:
        print(json.dumps(results))
        return 0
    print(f"{ROBOT} {JOINT}, enabled, torque mode, encoders changing; µs, the fastest {_PATTERN} of {seconds:g} s")
    print(f"  {'':20}" + "".join(f"{law:>10}" for law in results))
    for key, meaning in ROWS.items():
        cells = [result[f"{key}_us"] for result in results.values()]
        print(f"  {key:20}" + "".join(f"{'–' if c is None else f'{c:.2f}':>10}" for c in cells) + f"   {meaning}")
    worst = max(result["interrupt_us"] for result in results.values())
    print(f"  aim for the interrupt: ≤ {AIM_US:g} µs: {'met' if worst <= AIM_US else 'missed'}")
    return 0
