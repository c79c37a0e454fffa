"""Codecs of the bus messages: values survive within half a count and saturate beyond their range."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus import messages as m
from bus.messages import MalformedMessageError, Setpoint, State

u16 = st.integers(0, 2**16 - 1)
u8 = st.integers(0, 255)


def within(limit: int, scale: float) -> st.SearchStrategy[float]:
    return st.floats(-limit * scale, limit * scale, allow_nan=False)


states = st.builds(
    State, u16, u16,
    within(2**31 - 1, m.RADIAN), within(2**31 - 1, m.RADIAN_PER_SECOND), within(2**31 - 1, m.NEWTON_METRE),
    within(2**15 - 1, m.AMPERE), within(2**15 - 1, m.MOTOR_RADIAN_PER_SECOND), u16, u8, u8,
)  # fmt: skip
setpoints = st.builds(
    Setpoint, u16, st.integers(-128, 127), u8,
    within(2**31 - 1, m.NEWTON_METRE), within(2**31 - 1, m.RADIAN), within(2**31 - 1, m.RADIAN_PER_SECOND),
    st.floats(0, 65535 * m.TORQUE_LIMIT), u16,
)  # fmt: skip


@given(states)
def test_a_state_survives_within_half_a_count(state: State) -> None:
    data = m.encode_state(state)
    assert len(data) == m.STATE_LENGTH == 24
    back = m.decode_state(data)
    steps = (0, 0, m.RADIAN, m.RADIAN_PER_SECOND, m.NEWTON_METRE, m.AMPERE, 1e-3, 0, 0, 0)
    for name, sent, got, step in zip(State._fields, state, back, steps, strict=True):
        assert abs(sent - got) <= 0.5001 * step, name
    assert m.encode_state(back) == data


@given(st.lists(setpoints, max_size=m.SLOTS), u16)
def test_a_command_survives_and_unused_slots_are_disabled(sent: list[Setpoint], counter: int) -> None:
    data = m.encode_command(counter, sent)
    assert len(data) == m.COMMAND_LENGTH == 64
    assert m.command_counter(data) == counter
    steps = (0, 0, 0, m.NEWTON_METRE, m.RADIAN, m.RADIAN_PER_SECOND, m.TORQUE_LIMIT, 0)
    back = [m.decode_setpoint(data, slot) for slot in range(m.SLOTS)]
    for setpoint, got in zip(sent, back, strict=False):
        for name, a, b, step in zip(Setpoint._fields, setpoint, got, steps, strict=True):
            assert abs(a - b) <= 0.5001 * step, name
    for unused in back[len(sent) :]:
        assert unused == Setpoint(m.Controlword.DISABLE_VOLTAGE, m.Mode.NONE, torque_limit=0.0)


@given(st.sampled_from([1e12, -1e12, math.inf, -math.inf, 2.0**40]))
def test_values_out_of_range_keep_their_sign(value: float) -> None:
    state = m.decode_state(m.encode_state(State(0, 0, value, value, value, value, value, 0, 0, 300)))
    for got in state[2:7]:
        assert math.copysign(1, got) == math.copysign(1, value) and abs(got) > 30
    assert state.temperature == 255
    sent = Setpoint(torque=value, position=value, velocity=value, torque_limit=value)
    setpoint = m.decode_setpoint(m.encode_command(0, [sent]), 0)
    for got in (setpoint.torque, setpoint.position, setpoint.velocity):
        assert math.copysign(1, got) == math.copysign(1, value) and abs(got) > 1000
    assert setpoint.torque_limit == (pytest.approx(1310.7) if value > 0 else 0.0)


def test_nan_is_refused() -> None:
    with pytest.raises(ValueError):
        m.encode_state(State(0, 0, 0.0, math.nan, 0.0, 0.0, 0.0, 0, 0, 0))
    with pytest.raises(ValueError):
        m.encode_command(0, [Setpoint(torque=math.nan)])
    with pytest.raises(ValueError):
        m.encode_command(0, [Setpoint(torque=math.inf, position=math.nan)])


@given(st.binary(max_size=70))
def test_wrong_lengths_are_malformed(data: bytes) -> None:
    for decode, length in (
        (m.decode_state, m.STATE_LENGTH), (m.command_counter, m.COMMAND_LENGTH),
        (lambda d: m.decode_setpoint(d, 0), m.COMMAND_LENGTH), (m.decode_emergency, m.EMERGENCY_LENGTH),
    ):  # fmt: skip
        if len(data) == length:
            decode(data)
        else:
            with pytest.raises(MalformedMessageError):
                decode(data)
    with pytest.raises(MalformedMessageError):
        m.encode_command(0, [Setpoint()] * (m.SLOTS + 1))


@given(u16, u8, st.binary(max_size=5))
def test_an_emergency_survives(code: int, register: int, detail: bytes) -> None:
    data = m.encode_emergency(code, register, detail)
    assert m.decode_emergency(data) == (code, register, detail.ljust(5, b"\0"))


@given(u16, st.integers(1, 0x7FFF))
def test_counters_are_ordered_across_the_wrap(counter: int, ahead: int) -> None:
    later = (counter + ahead) & 0xFFFF
    assert m.newer(later, counter) and not m.newer(counter, later) and not m.newer(counter, counter)
