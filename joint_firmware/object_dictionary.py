"""A CANopen object dictionary (CiA 301 §7.4): what there is, of which type and range, and who answers for its value."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum

Value = int | float | str | bytes


class DataType(IntEnum):
    """Static data types (CiA 301 table 44)."""

    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    DOMAIN = 0x0F


class ObjectType(IntEnum):
    """Object codes (CiA 301 table 42)."""

    DOMAIN = 0x02
    VAR = 0x07
    ARRAY = 0x08
    RECORD = 0x09


class AbortCode(IntEnum):
    """SDO abort codes (CiA 301 table 22)."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(Exception):
    """An access is refused; ``code`` says why."""

    def __init__(self, code: AbortCode) -> None:
        super().__init__(code.name)
        self.code = code


_CODES = {
    DataType.INTEGER8: "b", DataType.INTEGER16: "h", DataType.INTEGER32: "i",
    DataType.UNSIGNED8: "B", DataType.UNSIGNED16: "H", DataType.UNSIGNED32: "I", DataType.REAL32: "f",
}  # fmt: skip
_STRUCTS = {kind: struct.Struct("<" + code) for kind, code in _CODES.items()}
_OF_CODE = {code: kind for kind, code in _CODES.items()}
_REAL32_MAX = 3.4028234663852886e38


def data_type(code: str) -> DataType:
    """The type of a struct code, e.g. "i": INTEGER32."""
    return _OF_CODE[code]


@dataclass(frozen=True, slots=True)
class Variable:
    """One sub-index. A value is in counts: ``factor`` times it is in ``unit``.

    ``access``: "const", "ro" or "rw". ``default``: value after power-on; of a constant, the value; None where the
    drive's present state decides. ``per_node``: the node id is added to the default. ``low`` and ``high``: range of
    what may be written, None for that of the type.
    """

    name: str
    type: DataType
    access: str = "ro"
    default: Value | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    factor: float = 1.0
    mappable: bool = False
    per_node: bool = False

    @property
    def size(self) -> int | None:
        """Length in bytes, None when it varies."""
        layout = _STRUCTS.get(self.type)
        return None if layout is None else layout.size

    @property
    def bits(self) -> int:
        """Length in a PDO."""
        return 8 * (self.size or 0)

    def encode(self, value: Value) -> bytes:
        """Bytes of ``value``; a number beyond the type's range saturates, for a master must not read a wrapped one."""
        if isinstance(value, str):
            return value.encode("ascii", "replace")
        if isinstance(value, bytes):
            return value
        if self.type == DataType.REAL32:
            return _STRUCTS[self.type].pack(min(max(value, -_REAL32_MAX), _REAL32_MAX))
        low, high = self.type_range()
        return _STRUCTS[self.type].pack(min(max(round(value), low), high))

    def decode(self, data: bytes) -> int | float:
        """The number in ``data``. Raises SdoAbort for a wrong length or a number out of range."""
        layout = _STRUCTS[self.type]
        if len(data) != layout.size:
            raise SdoAbort(AbortCode.TOO_LONG if len(data) > layout.size else AbortCode.TOO_SHORT)
        (value,) = layout.unpack(data)
        if not math.isfinite(value):
            raise SdoAbort(AbortCode.VALUE)
        if self.high is not None and value > self.high:
            raise SdoAbort(AbortCode.TOO_HIGH)
        if self.low is not None and value < self.low:
            raise SdoAbort(AbortCode.TOO_LOW)
        return value

    def type_range(self) -> tuple[int, int]:
        """Least and greatest number of an integer type."""
        bits = self.bits
        if _CODES[self.type].isupper():
            return 0, (1 << bits) - 1
        return -(1 << bits - 1), (1 << bits - 1) - 1


@dataclass(frozen=True, slots=True)
class Object:
    """One index: a variable, or an array or record of them by sub-index."""

    index: int
    name: str
    kind: ObjectType
    variables: dict[int, Variable]


def variable(index: int, variable: Variable) -> Object:
    """An object of one variable."""
    kind = ObjectType.DOMAIN if variable.type == DataType.DOMAIN else ObjectType.VAR
    return Object(index, variable.name, kind, {0: variable})


def record(index: int, name: str, variables: Iterable[Variable], kind: ObjectType = ObjectType.RECORD) -> Object:
    """A record (or array): ``variables`` from sub-index 1 on, their number at 0."""
    subs = dict(enumerate(variables, start=1))
    count = Variable("Highest sub-index supported", DataType.UNSIGNED8, "const", len(subs))
    return Object(index, name, kind, {0: count, **subs})


class ObjectDictionary:
    """The dictionary of one node: constants it knows itself, everything else it asks the functions connected to it."""

    def __init__(self, objects: Iterable[Object], node_id: int) -> None:
        self.objects = {entry.index: entry for entry in objects}
        self.node_id = node_id
        self._readers: dict[tuple[int, int], Callable[[], Value]] = {}
        self._writers: dict[tuple[int, int], Callable[[int | float], None]] = {}

    def connect(
        self,
        index: int,
        sub: int,
        read: Callable[[], Value],
        write: Callable[[int | float], None] | None = None,
    ) -> None:
        """Let ``read`` and ``write`` answer for a variable; ``write`` may raise SdoAbort."""
        self._readers[index, sub] = read
        if write is not None:
            self._writers[index, sub] = write

    def variable(self, index: int, sub: int) -> Variable:
        """Raises SdoAbort when there is none."""
        entry = self.objects.get(index)
        if entry is None:
            raise SdoAbort(AbortCode.NO_OBJECT)
        found = entry.variables.get(sub)
        if found is None:
            raise SdoAbort(AbortCode.NO_SUBINDEX)
        return found

    def writable(self, index: int, sub: int) -> Variable:
        """A variable that may be written. Raises SdoAbort when there is none."""
        found = self.variable(index, sub)
        if (index, sub) not in self._writers:
            raise SdoAbort(AbortCode.READ_ONLY)
        return found

    def read(self, index: int, sub: int) -> bytes:
        """The value as it goes over the bus. Raises SdoAbort."""
        found = self.variable(index, sub)
        reader = self._readers.get((index, sub))
        if reader is not None:
            return found.encode(reader())
        assert found.default is not None, f"nobody answers for {index:#06x}:{sub}"
        value = found.default
        return found.encode(value + self.node_id if found.per_node else value)  # type: ignore[operator]

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Take ``data`` over. Raises SdoAbort, and then nothing has changed."""
        value = self.writable(index, sub).decode(data)
        self._writers[index, sub](value)
