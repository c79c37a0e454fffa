"""The electronic data sheet of a drive (CiA 306): its object dictionary as a file, for any CANopen master."""

from __future__ import annotations

from collections.abc import Iterable

from joint_firmware.object_dictionary import DataType, Object, ObjectDictionary, ObjectType, Variable

_DATE = "11-25-2026"  # of the first edition of the objects; a date of writing would make every file differ


def eds(dictionary: ObjectDictionary) -> str:
    """Text of the EDS file. ``Factor`` and ``Unit`` are not in CiA 306; the ``canopen`` package reads them, others pass
    over them."""
    objects = dictionary.objects
    own = [i for i in objects if 0x2000 <= i < 0x6000]
    mandatory = [i for i in objects if i in (0x1000, 0x1001, 0x1018)]
    optional = [i for i in objects if i not in own and i not in mandatory]
    name = objects[0x1008].variables[0].default
    identity = objects[0x1018].variables
    lines = [
        *_section("FileInfo", FileName=f"{str(name).replace(' ', '_')}.eds", FileVersion=1, FileRevision=0,
                  EDSVersion="4.0", Description=name, CreationTime="12:00AM", CreationDate=_DATE,
                  CreatedBy="hume-hil", ModificationTime="12:00AM", ModificationDate=_DATE, ModifiedBy="hume-hil"),
        *_section("DeviceInfo", VendorName="hume-hil", VendorNumber=identity[1].default, ProductName="joint drive",
                  ProductNumber=identity[2].default, RevisionNumber=identity[3].default, OrderCode="none",
                  **{f"BaudRate_{k}": 1 for k in (10, 20, 50, 125, 250, 500, 800, 1000)},
                  SimpleBootUpMaster=0, SimpleBootUpSlave=1, Granularity=0, DynamicChannelsSupported=0,
                  GroupMessaging=0, NrOfRXPDO=1, NrOfTXPDO=1, LSS_Supported=0),
        *_section("DummyUsage", **{f"Dummy{n:04d}": int(n in (DataType.UNSIGNED16, DataType.UNSIGNED32))
                                   for n in range(1, 8)}),
        *_section("Comments", Lines=0),
    ]  # fmt: skip
    for title, indices in (("Mandatory", mandatory), ("Optional", optional), ("Manufacturer", own)):
        listed = {str(n): f"0x{index:04X}" for n, index in enumerate(indices, start=1)}
        lines += _section(f"{title}Objects", SupportedObjects=len(indices), **listed)
        for index in indices:
            lines += _object(objects[index])
    return "\n".join(lines)


def _section(title: str, **entries: object) -> list[str]:
    return [f"[{title}]", *[f"{key}={value}" for key, value in entries.items()], ""]


def _object(entry: Object) -> Iterable[str]:
    section = f"{entry.index:04X}"
    if entry.kind in (ObjectType.VAR, ObjectType.DOMAIN):
        return _variable(section, entry.variables[0], entry.kind)
    head = _section(section, ParameterName=entry.name, ObjectType=f"0x{entry.kind:X}", SubNumber=len(entry.variables))
    subs = [_variable(f"{section}sub{sub:X}", variable) for sub, variable in entry.variables.items()]
    return [*head, *[line for lines in subs for line in lines]]


def _variable(section: str, variable: Variable, kind: ObjectType = ObjectType.VAR) -> list[str]:
    entries: dict[str, object] = {
        "ParameterName": variable.name,
        "ObjectType": f"0x{kind:X}",
        "DataType": f"0x{variable.type:04X}",
        "AccessType": variable.access,
    }
    if variable.per_node:
        entries["DefaultValue"] = f"$NODEID+{hex(variable.default)}"  # type: ignore[arg-type]
    elif variable.default is not None:
        entries["DefaultValue"] = variable.default
    for key, limit in (("LowLimit", variable.low), ("HighLimit", variable.high)):
        if limit is not None:
            entries[key] = limit
    entries["PDOMapping"] = int(variable.mappable)
    if variable.unit:
        entries["Unit"] = variable.unit
    if variable.factor != 1.0:
        entries["Factor"] = variable.factor
    return _section(section, **entries)
