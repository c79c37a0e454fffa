"""docs/zenoh.md against the code: the tables there are read, and a bundle is built from them alone."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from bus import zenoh_link
from bus.zenoh_link import decode_bundle, encode_bundle, keys

TEXT = (Path(__file__).parents[2] / "docs" / "zenoh.md").read_text(encoding="utf-8")
CODES = {"u8": "B", "u16": "H", "u32": "I", "i64": "q"}


def table(title: str) -> tuple[struct.Struct, list[str]]:
    """Layout and fields of the table under ``title``; its offsets are checked here."""
    size = int(re.search(rf"^{title}, (\d+) bytes", TEXT, re.M).group(1))  # type: ignore[union-attr]
    body = TEXT.split(f"{title}, {size} bytes")[1].split("\n\n")[1]
    rows = re.findall(r"^\| (\d+) \| (\w+) \| (\w+) \|", body, re.M)
    layout = struct.Struct("<" + "".join(CODES[kind] for _, kind, _ in rows))
    at = 0
    for offset, kind, _ in rows:
        assert at == int(offset)
        at += struct.calcsize("<" + CODES[kind])
    assert at == layout.size == size
    return layout, [name for _, _, name in rows]


def test_a_bundle_built_from_the_document_is_read() -> None:
    header, header_fields = table("Header")
    item, item_fields = table("Item")
    fields = {"magic": 0x4C48, "version": 2, "reserved": 0, "sequence": 77, "time": 123456789, "items": 2, "values": 3}
    first = {"arrival": 5, "identifier": 0x184, "source": 1, "length": 3}
    second = {"arrival": 6, "identifier": 0, "source": 255, "length": 0}
    payload = header.pack(*[fields[name] for name in header_fields])
    payload += item.pack(*[first[name] for name in item_fields]) + b"abc"
    payload += item.pack(*[second[name] for name in item_fields]) + struct.pack("<3d", 1.5, -2.0, 0.0)
    bundle = decode_bundle(payload)
    assert (bundle.sequence, bundle.time_ns) == (77, 123456789)
    assert bundle.items == [(5, 1, 0x184, b"abc"), (6, 255, 0, b"")]
    assert bundle.values.tolist() == [1.5, -2.0, 0.0]
    assert payload == encode_bundle(77, 123456789, bundle.items, np.array([1.5, -2.0, 0.0]))


def test_keys_and_version_are_those_of_the_document() -> None:
    assert f"## Bundle, version {zenoh_link.VERSION}" in TEXT
    documented = re.findall(r"^\| `hil/RUN/(\w+)`", TEXT, re.M)
    assert [f"hil/r/{name}" for name in documented] == [getattr(keys("r"), name) for name in documented]
    assert {"state", "command", "inject"} <= set(documented)


def test_reasons_for_refusal_are_those_of_the_document() -> None:
    assert set(re.findall(r"^- `(\w+)`: ", TEXT, re.M)) == set(zenoh_link.Refused().report())


@pytest.mark.parametrize("name", ["router.json5", "hil.json5"])
def test_the_examples_are_linked(name: str) -> None:
    assert f"(zenoh/{name})" in TEXT
