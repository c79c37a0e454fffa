"""What single precision costs: a bound for every output at every step, and outputs that keep to it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.commands.bench_joint import exported
from hil.record.law_recording import LawRecording
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.c99 import PRECISIONS, export
from joint_firmware.export.drive_law import ExportedLaw, exported_law
from joint_firmware.laws import signals as law
from robots import description, pins
from tests.support.exports import build, need, need_m32, numbers, rows, run, same_bits, write
from tests.support.rounding import Bounded, bounds, stored

HUME = description.load("hume")
CONFIG = FirmwareConfig()
LAW = exported_law(HUME.joint("left_knee"), CONFIG)
PARAMETERS = [q.name for q in LAW.parameters]
STATES = [q.name for q in LAW.state]
VELOCITIES = [STATES.index("motor_velocity"), STATES.index("deflection_velocity")]


@pytest.fixture(scope="session")
def knee(recorded: dict[str, LawRecording]) -> LawRecording:
    return recorded["left_knee"]


def bounded(drive: LawRecording, state: Bounded) -> tuple[Bounded, Bounded]:
    """Next state and outputs of all steps; of ``state`` before each."""
    counts = stored(drive.counts.astype(np.float64))
    x_next, y = bounds(LAW.program, [counts, state, stored(drive.u), stored(drive.p)])
    assert np.array_equal(x_next.value, drive.x_next) and np.array_equal(y.value, drive.y)  # it is the same law
    return x_next, y


def kept(computed: np.ndarray, bound: Bounded) -> np.ndarray:
    return np.abs(computed.astype(np.float64) - bound.value) <= bound.error


def test_one_step_keeps_to_its_bound(knee: LawRecording) -> None:
    """From the emulation's own state, rounded."""
    need("cc", "gcc libc6-dev")
    x_next, y = bounded(knee, stored(knee.x))
    with exported(LAW._replace(values=knee.p), "single") as drive:
        for k in range(len(knee.x)):
            drive.x[:], drive.u[:] = knee.x[k], knee.u[k]
            drive.step(knee.counts[k])
            assert kept(np.array(drive.x), Bounded(x_next.value[k], x_next.error[k])).all(), k
            assert kept(np.array(drive.y), Bounded(y.value[k], y.error[k])).all(), k
    # and the bound says something: these are what docs/export.md states
    worst = y.error.max(axis=0)
    assert worst[[law.Y_POSITION, law.Y_TORQUE, law.Y_MOTOR_VELOCITY, law.Y_DEMAND]].max() < 1.001
    assert worst[law.Y_TRIPS] == 0  # nothing is so close to its limit that the precisions could disagree
    assert worst[law.Y_POSITION_SI] < 3e-7 and worst[law.Y_TORQUE_SI] < 1e-5
    a_count = np.abs(LAW.values[PARAMETERS.index("rad_per_count")])
    assert x_next.error[:, VELOCITIES].max() < 4e-4 < 0.01 * a_count * CONFIG.rate  # what a count within a step makes


def free_running_state(knee: LawRecording) -> Bounded:
    """Bound of the state of a law in single precision that keeps its own, at any step.

    What of the state is computed from the pins of the same step alone does not add up. The velocities' filter keeps
    1 − blend of its error at every step, so that what a step adds is multiplied by 1 / blend at most. Of the rest of
    the state no bound is needed: no sensed output depends on it.
    """
    assert not knee.u[:, law.U_KI].any() and not knee.x[:, STATES.index("integral")].any()
    one, _ = bounded(knee, stored(knee.x))
    error = np.broadcast_to(one.error.max(axis=0), knee.x.shape).copy()
    error[:, VELOCITIES] /= LAW.values[PARAMETERS.index("velocity_blend")]
    return Bounded(knee.x, error)


def test_a_second_on_its_own_state_keeps_to_the_bound(knee: LawRecording, tmp_path: Path) -> None:
    files = export(HUME, ["left_knee"], "single", CONFIG)
    example = build(write(files, tmp_path / "single"), "-O2")
    computed = numbers(run([example], rows(knee)), "single")
    outputs, states = np.hsplit(computed, [law.OUTPUT_SIZE])
    state = free_running_state(knee)
    _, y = bounded(knee, state)
    assert kept(states[:, VELOCITIES], Bounded(knee.x_next[:, VELOCITIES], state.error[:, VELOCITIES])).all()
    certain = [law.Y_POSITION, law.Y_TORQUE, law.Y_TORQUE_SI, law.Y_POSITION_SI, law.Y_CURRENT, law.Y_VELOCITY]
    assert kept(outputs[:, certain], Bounded(y.value[:, certain], y.error[:, certain])).all()
    demand = np.abs(outputs[:, law.Y_DEMAND] - knee.y[:, law.Y_DEMAND])
    assert demand.max() <= 1 and (demand > 0).mean() < 0.01  # 0.01 A, now and then


def test_it_is_the_same_on_a_processor_that_keeps_more_bits(knee: LawRecording, tmp_path: Path) -> None:
    """x87 computes with 64 bits and rounds when a result is stored. With one operation per statement the second
    rounding does no harm: 64 ≥ 2 · 24 + 2 (Figueroa 1995, When is double rounding innocuous?)."""
    need_m32(tmp_path)
    files = export(HUME, ["left_knee"], "single", CONFIG)
    directory = write(files, tmp_path / "single")
    outputs = [
        numbers(run([build(directory, *flags, name=f"built{n}")], rows(knee)), "single")
        for n, flags in enumerate([("-O2",), ("-O2", "-m32", "-mno-sse", "-mfpmath=387"), ("-O0", "-m32")])
    ]
    assert same_bits(outputs[0], outputs[1]) and same_bits(outputs[0], outputs[2])


def test_the_thermal_model_loses_no_slow_warming() -> None:
    """2000 s at 5 A, as docs/export.md tells it.

    A rounding of half a bit, e, at every step of the model acts like a warming of e / step. In the end the housing's
    cooling holds it, at e / (step housing_share), and the winding's, which the housing gets with the ratio of their
    rates. Current and time are summed over 300 interrupts: 300 roundings of half a bit at most.
    """
    need("cc", "gcc libc6-dev")
    values = dict(zip(PARAMETERS, LAW.values, strict=True))
    counts = np.zeros(pins.N_INPUTS, np.int32)
    counts[pins.TEMPERATURE_ADC], counts[pins.CURRENT_ADC] = 250, 500
    winding = {}
    for precision in ("double", "single"):
        with exported(LAW, precision) as drive:
            drive.steps(counts, 2000 * 3000)
            winding[precision] = float(drive.x[STATES.index("winding_temperature")])
    half_a_bit = 2.0**-24 * 32  # of numbers from 32 to 64
    both = 1 + values["housing_rate"] / values["winding_rate"]
    rounded = both * half_a_bit / (values["heat_step"] * values["housing_share"])
    summed = 300 * 2.0**-24 * (winding["double"] - 25.0)
    assert rounded + summed < 0.05
    assert winding["double"] == pytest.approx(41.5, abs=0.05)
    assert abs(winding["single"] - winding["double"]) < rounded + summed


# --- far from what a run has ------------------------------------------------------------------------------------


def step(one: ExportedLaw, counts: dict[int, int], **inputs: float) -> tuple[np.ndarray, np.ndarray]:
    """y in single and in double precision, of a law just started."""
    u = np.array([inputs.get(q.name, 0.0) for q in one.input])
    values = np.zeros(pins.N_INPUTS, np.int32)
    values[list(counts)] = list(counts.values())
    with exported(one, "single") as drive:
        drive.u[:] = u
        drive.step(values)
        single = np.array(drive.y)
    return single, np.array(one.function(values, np.zeros(len(one.state)), u, one.values)[1]).ravel()


def test_encoders_count_exactly_up_to_two_to_the_24(tmp_path: Path) -> None:
    """Beyond, a count is lost now and then: Hume's finest encoder gets there after 119 rad."""
    need("cc", "gcc libc6-dev")
    plain = LAW._replace(values=LAW.values.copy())
    plain.values[PARAMETERS.index("rad_per_count")] = 1.0
    for count, expected in ((2**24, 2**24), (2**24 + 1, 2**24), (-(2**24) - 1, -(2**24)), (2**24 + 2, 2**24 + 2)):
        single, double = step(plain, {pins.MOTOR_ENCODER: count})
        assert (single[law.Y_POSITION_SI], double[law.Y_POSITION_SI]) == (expected, count)
    finest = max(abs(joint.sensor.encoder) for joint in HUME.joints)
    assert 2**24 / finest == pytest.approx(119.8, abs=0.1)


def test_what_is_bounded_to_an_integer_s_range_stays_in_it() -> None:
    """2^31 − 1 is no single: rounded to the nearest it would be 2^31, which an int32_t cannot hold."""
    need("cc", "gcc libc6-dev")
    for count in (2**31 - 1, -(2**31)):
        single, double = step(LAW, dict.fromkeys((pins.MOTOR_ENCODER, pins.SPRING_ENCODER, pins.CURRENT_ADC), count))
        assert abs(double[law.Y_POSITION]) == 2**31 - 1 and abs(single[law.Y_POSITION]) == 2**31 - 2**7
        assert np.array_equal(np.sign(single), np.sign(double))
        assert abs(single[law.Y_CURRENT]) == abs(double[law.Y_CURRENT]) == 2**15 - 1


@given(st.floats(allow_nan=False, allow_infinity=False, width=32) | st.integers(-(2**40), 2**40).map(float))
def test_constants_are_the_nearest_numbers_and_whole_ones_no_larger(value: float) -> None:
    text = PRECISIONS["single"].literal(value)
    assert text.endswith("f") and ("." in text or "e" in text)
    read = float(np.float32(text.rstrip("f")))
    nearest = float(np.float32(value))
    if value.is_integer() and abs(value) > 2**24:
        assert abs(read) <= abs(value) and abs(read) >= abs(value) * (1 - 2**-23)
    else:
        assert read == nearest
    assert float(PRECISIONS["double"].literal(value)) == value
