"""Scenarios: what is valid loads as it was written; every mistake is refused with one sentence that helps."""

import re
import tomllib
import types
import typing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import annotated_types
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from bus.config import BusConfig
from central_controller.planning.config import OpenLoopConfig, ReachConfig
from hil.errors import UserError
from hil.scenario import Scenario, builtin_names, load, notes, parse_value, to_toml, validate
from robots.terrain import Block

TEXT = st.text(st.characters(codec="utf-8"), max_size=12)


def values_of(kind: Any, metadata: tuple[Any, ...] = ()) -> st.SearchStrategy[Any]:
    """Valid values of a field, as a file would hold them."""
    if get_origin(kind) is Annotated:
        kind, *inner = get_args(kind)
        return values_of(kind, (*metadata, *inner))
    flat = [m for entry in metadata for m in (entry.metadata if isinstance(entry, FieldInfo) else [entry])]
    extras = [m.json_schema_extra for m in metadata if isinstance(m, FieldInfo) and m.json_schema_extra]
    origin = get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return values_of(next(a for a in get_args(kind) if a is not type(None)), metadata)
    if origin is Literal:
        return st.sampled_from(get_args(kind))
    if origin is tuple and get_args(kind)[-1] is Ellipsis:
        return st.lists(values_of(get_args(kind)[0]), max_size=2)
    if origin is tuple:
        return st.tuples(*[values_of(a) for a in get_args(kind)]).map(list)
    if origin is dict:
        return st.dictionaries(TEXT, values_of(get_args(kind)[1]), max_size=2)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return tables_of(kind)
    if kind is bool:
        return st.booleans()
    if kind is str:
        return TEXT
    low, high = -1e5, 1e5
    for bound in flat:
        match bound:
            case annotated_types.Ge(ge=at):
                low = at
            case annotated_types.Gt(gt=at):
                low = at + 1e-3
            case annotated_types.Le(le=at):
                high = min(at, high)
            case annotated_types.Lt(lt=at):
                high = at - 1e-3
    if kind is int:
        return st.integers(int(low), int(high))
    numbers = st.floats(low, high)
    return numbers.map(lambda v: f"{v!r} {extras[0]['unit']}") if extras else numbers


def tables_of(model: type[BaseModel]) -> st.SearchStrategy[dict[str, Any]]:
    fields = {name: values_of(field.annotation, (field,)) for name, field in model.model_fields.items()}
    if model is Scenario:
        fields["name"] = st.just("any name")
    if "damage" in fields:
        fields["damage"] = st.sampled_from(["", "0x182 crc:3", "5 17 2"])
    required = {name: s for name, s in fields.items() if model.model_fields[name].is_required()}
    optional = {name: s for name, s in fields.items() if name not in required}
    tables = st.fixed_dictionaries(required, optional=optional)
    return tables.filter(partial(accepted, model)) if model in (Block, OpenLoopConfig, ReachConfig) else tables


def accepted(model: type[BaseModel], table: dict[str, Any]) -> bool:
    """Whether the fields of ``table`` go together, where that is more than their own bounds."""
    try:
        model.model_validate(table)
    except ValidationError:
        return False
    return True


@settings(max_examples=60)
@given(tables_of(Scenario))
def test_a_dumped_scenario_loads_as_an_equal_one(data: dict[str, Any]) -> None:
    scenario = validate(data)
    assert validate(tomllib.loads(to_toml(scenario.model_dump(mode="json")))) == scenario


@pytest.mark.parametrize("name", builtin_names())
def test_every_built_in_scenario_is_repeated_by_its_dump(name: str, tmp_path: Path) -> None:
    scenario = load(name)
    assert scenario.duration > scenario.limits.settle and scenario.description
    file = tmp_path / "again.toml"
    file.write_text(to_toml(scenario.model_dump(mode="json")), encoding="utf-8")
    assert load(str(file)) == scenario


KEYS = [
    ["duration"], ["world", "rate"], ["link", "command", "delay"], ["controller", "tasks", "com_x", "kp"],
    ["bus", "left_leg", "loss"], ["limits", "settle"],
]  # fmt: skip


@given(st.sampled_from(KEYS), st.text("abcdefghijklmnopqrstuvwxyz_", min_size=1, max_size=10), st.data())
def test_an_unknown_key_is_refused_with_its_path(path: list[str], word: str, data: st.DataObject) -> None:
    """Anywhere in the schema, whatever the word."""
    table = path[: data.draw(st.integers(0, len(path) - 1))]
    if table == ["bus"]:
        table = []
    key = ".".join([*table, word])
    kind: Any = Scenario
    for part in table:
        kind = BusConfig if kind is dict else kind.model_fields[part].annotation
        kind = dict if get_origin(kind) is dict else kind
    if word in kind.model_fields:
        return
    with pytest.raises(UserError) as refusal:
        load("stand", [f"{key}=1"])
    sentence = str(refusal.value)
    assert sentence.startswith(f"stand: unknown key {key!r}; ") and "\n" not in sentence
    assert re.search(r"did you mean '[\w.]+'\?$|valid are [\w, ]+$", sentence)


@given(st.floats(0, 1e3), st.sampled_from([("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9)]))
def test_a_value_is_parsed_as_the_scenario_would(value: float, unit: tuple[str, float]) -> None:
    assert parse_value("link.command.delay", f"{value!r}{unit[0]}") == pytest.approx(value * unit[1], rel=1e-12)


@given(
    st.text(max_size=30),
    st.text(max_size=12) | st.floats() | st.none() | st.booleans() | st.lists(st.integers()),
)
def test_any_key_and_value_is_read_or_refused(key: str, value: Any) -> None:
    for name in (key, "link.command.delay", "bus.left_leg.loss", "world.variant"):
        try:
            assert isinstance(parse_value(name, value), float | int | str)
        except UserError as error:
            assert len(str(error)) < 1000


@given(st.text(max_size=40))
def test_any_setting_is_taken_or_refused(setting: str) -> None:
    for text in (setting, f"link.command.delay={setting}", f"{setting}=1s", f"push={setting}"):
        try:
            assert isinstance(load("stand", [text]), Scenario)
        except UserError as error:
            assert str(error)


@settings(max_examples=50)
@given(st.binary(max_size=60))
def test_any_file_is_read_or_refused(tmp_path_factory: Any, content: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "any.toml"
    file.write_bytes(content)
    try:
        assert isinstance(load(str(file)), Scenario)
    except UserError as error:
        assert str(error).startswith(str(file))


SECONDS = "s, ms, us, µs, ns"
MISTAKES = {
    "link.comand.delay=3ms": "unknown key 'link.comand'; did you mean 'link.command'?",
    "link.command.dely=3ms": "unknown key 'link.command.dely'; did you mean 'link.command.delay'?",
    "bus.left_lg.loss=0.1": "unknown key 'bus.left_lg'; did you mean 'bus.left_leg'?",
    "link.command.delay=3": f'link.command.delay = 3: 3 has no unit: write one of {SECONDS}, for example "3s"',
    "link.command.delay=3kg": f"link.command.delay = '3kg': unit 'kg' in '3kg' does not fit: use one of {SECONDS}",
    "link.command.delay=-3ms": "link.command.delay = '-3ms': expected at least 0 s",
    "link.command.delay=1e7s": "link.command.delay = '1e7s': expected at most 1e+06 s",
    "link.command.delay=1e400s": "link.command.delay = '1e400s': '1e400s' is too large",
    "link.command.loss=1.5": "link.command.loss = 1.5: expected at most 1",
    "link.command.loss=often": "link.command.loss = 'often': expected a finite number",
    "link.command.loss=nan": "link.command.loss = nan: expected a finite number",
    "link.command=3": "link.command = 3: expected a table with delay, jitter, jitter_shape, loss, burst, "
    "bit_error_rate, corruption, duplicate, reorder",
    "bus.left_leg=3": "bus.left_leg = 3: expected a table with delay, jitter, jitter_shape, loss, burst, "
    "bit_error_rate, corruption, duplicate, reorder, arbitration_rate, data_rate, queue, bus_off_recovery, "
    "damage, babble, background, node",
    "link.command.burst.entr=1": "unknown key 'link.command.burst.entr'; did you mean 'link.command.burst.enter'?",
    "link.command.jitter_shape=cauchy": "link.command.jitter_shape = 'cauchy': expected 'uniform', 'normal', "
    "'exponential', 'lognormal' or 'pareto'",
    "bus.left_leg.babble.identifier=0x800": "bus.left_leg.babble.identifier = 2048: expected at most 2047",
    "bus.left_leg.babble.identifier=x": "bus.left_leg.babble.identifier = 'x': expected a whole number",
    "bus.left_leg.babble.rate=1MHz": "bus.left_leg.babble.rate = '1MHz': expected at most 100000 Hz",
    "bus.left_leg.background.load=1": "bus.left_leg.background.load = 1: expected at most 0.99",
    "bus.left_leg.background.length=9": "bus.left_leg.background.length = 9: expected 0, 1, 2, 3, 4, 5, 6, 7, 8, 12, "
    "16, 20, 24, 32, 48 or 64",
    "bus.left_leg.damage=182h crc": "bus.left_leg.damage = '182h crc': expected \"IDENTIFIER BIT\" or "
    '"IDENTIFIER BIT ATTEMPT", for example "0x182 crc:3"',
    "bus.left_leg.node.left_knee.cut=2": "bus.left_leg.node.left_knee.cut = 2: expected true or false",
    "bus.left_leg.node.left_knee.drift=5": "bus.left_leg.node.left_knee.drift = 5: 5 has no unit: write one of ppm, "
    'for example "5ppm"',
    "bus.left_leg.node.left_kne.cut=true": "unknown key 'bus.left_leg.node.left_kne'; did you mean "
    "'bus.left_leg.node.left_knee'?",
    "bus.left_leg.node.gateway.drift=5ppm": "bus.left_leg.node.gateway.drift: only joints have this fault",
    "bus=3": "bus = 3: expected a table of tables",
    "push=3": "push = 3: expected a list",
    "push=[{at='1s', duration='1s', force=['1N']}]": "push.0.force = ['1N']: expected 3 values",
    "push=[{at='1s'}]": "push.0.duration is missing",
    "push=[{at='1s', frce=1}]": "unknown key 'push.0.frce'; did you mean 'push.0.force'?",
    "world.rate=0Hz": "world.rate = '0Hz': expected more than 0 Hz",
    "world.rate=-1kHz": "world.rate = '-1kHz': expected more than 0 Hz",
    "world.rate=3000.5Hz": "world.rate = 3000.5 Hz: expected a whole number of hertz, at most 1 MHz",
    "world.rate=1kHz": "world.rate = 1000 Hz: must be a multiple of firmware.rate (3000 Hz)",
    "world.shank_stiffness=9001Nm/rad": "world.shank_stiffness = 9001 N m/rad: expected at most 9000 N m/rad with "
    "world.rate = 3000 Hz, or 0 for rigid shanks",
    "firmware.report_rate=700Hz": "firmware.rate = 3000 Hz: must be a multiple of firmware.report_rate (700 Hz)",
    "firmware.joints.left_hp.swing.kp=5": "unknown key 'firmware.joints.left_hp'; did you mean "
    "'firmware.joints.left_hip'?",
    "firmware.joints.left_hip.swing.kq=5": "unknown key 'firmware.joints.left_hip.swing.kq'; did you mean "
    "'firmware.joints.left_hip.swing.kp'?",
    "firmware.joints.left_hip.swing.kd=-1": "firmware.joints.left_hip.swing.kd = -1: -1 has no unit: write one of "
    'N m s/rad, Nm s/rad, Nms/rad, for example "-1N m s/rad"',
    "firmware.law=LQR": "firmware.law = 'LQR': expected 'PD_f', 'PD_m', 'PID_m', 'PD_m+DOB', 'cascade' or 'valve'",
    "firmware.observer_cutoff=1500Hz": "firmware.observer_cutoff = 1500 Hz: expected less than half of firmware.rate "
    "(3000 Hz)",
    "controller.compute_time=1ms": "controller.compute_time = 1 ms: must be less than the controller's period, "
    "0.6667 ms at controller.rate = 1500 Hz",
    "controller.phase=700us": "controller.phase = 0.7 ms: must be less than the controller's period, "
    "0.6667 ms at controller.rate = 1500 Hz",
    "controller.phase=-1us": "controller.phase = '-1us': expected at least 0 s",
    "controller.path.period=0s": "controller.path.period = 0 s: expected more than 0 s",
    "controller.stand_at=-1s": "controller.stand_at = '-1s': expected at least 0 s",
    "world.hoist.hold=-1s": "world.hoist.hold = '-1s': expected at least 0 s",
    "world.planarizer.enabled=maybe": "world.planarizer.enabled = 'maybe': expected true or false",
    "terrain.kind=hill": "terrain.kind = 'hill': expected 'flat' or 'split'",
    "terrain.panel_angle=2rad": "terrain.panel_angle = '2rad': expected less than 1.4 rad",
    "limits.com_error=-1mm": "limits.com_error = '-1mm': expected at least 0 m",
    "duration=0s": "duration = 0 s: expected more than 0 s",
    "robot=atlas": "robot = 'atlas': no robot 'atlas'; there is: hume, valve, vlca, or the path of a TOML file",
    "world.variant=heavy": "world.variant = 'heavy': hume has no variant 'heavy'; there is: srlib",
    "controller.variant=3": "controller.variant = 3: expected a text in quotes",
    'name="a/b"': "name = 'a/b': expected 1 to 64 characters, none of / * $ ? #",
    "inject=[{at='1s', key='link.command.dely', value='1ms'}]": "inject.0.key = 'link.command.dely': no such key; "
    "did you mean 'link.command.delay'?",
    "inject=[{at='1s', key='link.command.loss', value=2}]": "inject.0.value: link.command.loss = 2.0: "
    "expected at most 1",
    "inject=[{at='1s', key='link.command.loss', value=[2]}]": "inject.0.value = [2]: expected a text in quotes",
    "inject=[{at='1s', key='bus.left_leg.node.left_knee.ct', value=true}]": "inject.0.key = "
    "'bus.left_leg.node.left_knee.ct': no such key; did you mean 'bus.left_leg.node.left_knee.cut'?",
    "inject=[{at='2s', until='1s', key='link.command.loss', value=1}]": "inject.0.until = 1 s: expected more than its "
    "at, 2 s",
    "inject=[{at='2s', until='4s', key='link.command.loss', value=1}, "
    "{at='3s', key='link.command.loss', value=0}]": "inject.1.at = 3 s: link.command.loss is under inject.0 until 4 s",
}


@pytest.mark.parametrize("setting", MISTAKES)
def test_a_mistake_is_named(setting: str) -> None:
    with pytest.raises(UserError) as refusal:
        load("stand", [setting])
    assert str(refusal.value) == f"stand: {MISTAKES[setting]}"


@pytest.mark.parametrize("setting", ["link.command.delay", "=3ms", ".=3", "a..b=3", " =1"])
def test_a_setting_needs_a_key_and_a_value(setting: str) -> None:
    with pytest.raises(UserError, match=r"expected KEY=VALUE, for example --set link.command.delay=3ms$"):
        load("stand", [setting])


def test_a_gain_that_is_set_leaves_the_others_of_its_set_alone() -> None:
    plain = load("stand", []).firmware
    changed = load("stand", ["firmware.stance.kp=4.5", "firmware.swing.kd=2Nms/rad"]).firmware
    assert changed.stance == plain.stance.model_copy(update={"kp": 4.5}) != plain.stance
    assert changed.swing == plain.swing.model_copy(update={"kd": 2.0}) != plain.swing


def test_gains_of_one_joint_override_those_of_all_and_only_what_is_given() -> None:
    """As Kim 2018 Table 7.1 has it: left and right joints swing with different gains."""
    settings = ["firmware.joints.left_hip.swing.kp=32.7", "firmware.joints.left_hip.swing.ki=3.48"]
    firmware = load("stand", settings).firmware
    left, right = firmware.of_joint("left_hip"), firmware.of_joint("right_hip")
    assert (left.swing.kp, left.swing.ki, left.swing.kd) == (32.7, 3.48, firmware.swing.kd)
    assert left.stance == right.stance == firmware.stance and right.swing == firmware.swing


def test_a_torque_loop_that_cannot_be_stable_is_refused_and_one_that_is_not_passive_is_told() -> None:
    assert notes(load("stand", ["firmware.law=cascade"])) == []
    slow = ["firmware.law=cascade", "firmware.velocity_integral=2", "firmware.joints.left_knee.swing.ki=100"]
    (note,) = notes(load("stand", slow))
    assert note.startswith("left_knee, firmware.swing: the cascade is not passive at low frequencies: ki = 100 1/s")
    with pytest.raises(UserError, match=r"left_knee, firmware\.swing: the cascade with kp = 4, ki = 6000 1/s"):
        load("stand", ["firmware.law=cascade", "firmware.joints.left_knee.swing.ki=6000"])
    assert len(notes(load("stand", ["firmware.law=valve"]))) == 6


def test_a_path_through_a_value_or_a_list_is_refused() -> None:
    with pytest.raises(UserError, match=r"^duration.x: 'duration' is a value, not a table$"):
        load("stand", ["duration.x=3s"])
    with pytest.raises(UserError, match=r"^push.0.at: 'push' is a list; give all of it"):
        load("split-terrain-push", ["push.0.at=3s"])


def test_settings_apply_in_order_with_toml_or_bare_values() -> None:
    scenario = load("stand", ["duration=3s", "duration=4s", 'link.state.delay="2ms"', "link.state.loss=0.5"])
    assert (scenario.duration, scenario.link.state.delay, scenario.link.state.loss) == (4.0, 0.002, 0.5)
    assert load("stand", ["description=two\nlines"]).description == "two\nlines"
    with pytest.raises(UserError, match=r"link\.state\.loss"):
        load("stand", ["link.state.loss=1\nduration=1"])  # not a second key by the back door


@pytest.mark.parametrize("content, words", [
    (b"a = [", "not valid TOML"), (b"\xff\xfe", "not UTF-8"), (b"a = 1\na = 2", "not valid TOML"),
    (b"a = " + b"[" * 2000, "not valid TOML"), (b"a = " + b"9" * 5000, "not valid TOML"), (None, "No such file"),
])  # fmt: skip
def test_an_unreadable_file_is_named(tmp_path: Path, content: bytes | None, words: str) -> None:
    file = tmp_path / "mine.toml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UserError, match=words) as refusal:
        load(str(file))
    assert str(refusal.value).startswith(f"{file}: ")


def test_an_unknown_scenario_names_the_nearest() -> None:
    with pytest.raises(UserError, match="did you mean 'split-terrain'"):
        load("split-terain")
    with pytest.raises(UserError, match=r"valid are .*stand"):
        load("zzz")


def test_all_buses_are_there_with_their_defaults() -> None:
    scenario = load("stand", ["bus.left_leg.loss=0.1"])
    assert scenario.bus["left_leg"].loss == 0.1 and scenario.bus["right_leg"] == BusConfig()


def test_a_controller_knows_the_terrain_s_blocks_unless_it_is_told_others() -> None:
    (platform,) = load("platform").terrain.blocks
    assert load("platform").controller.blocks == (platform,)
    assert load("platform", ["controller.blocks=[]"]).controller.blocks == ()
    assert load("stand").controller.blocks == ()
    with pytest.raises(UserError, match=r"platform: controller\.stepping\.planner\.ramp = 0\.9 m is too long"):
        load("platform", ["controller.stepping.planner.ramp=0.9m"])
