"""The worked example: an interrupt on a Cortex-M4F, compiled for it and, in QEMU, run on it."""

import re
import subprocess
from pathlib import Path

import pytest

from hil.record.law_recording import LawRecording
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.c99 import export
from joint_firmware.export.drive_law import exported_law
from robots import description
from tests.support.exports import ARM, QEMU, STRICT, build, need, numbers, rows, run, same_bits, write

HUME = description.load("hume")
LAW = exported_law(HUME.joint("left_knee"), FirmwareConfig())
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "stm32g4"
PACKAGES = "gcc-arm-none-eabi libnewlib-arm-none-eabi"


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    files = export(HUME, ["left_knee"], "single", FirmwareConfig())
    return write(files, tmp_path_factory.mktemp("cortex"))


def program(firmware: Path, name: str, *sources: Path | str) -> Path:
    """A program for QEMU's board."""
    need("arm-none-eabi-gcc", PACKAGES)
    need("qemu-system-arm", "qemu-system-arm")
    link = ["--specs=rdimon.specs", "-T", EXAMPLE / "mps2.ld", "-o", name]
    both = [EXAMPLE / "startup.c", *sources, "joint_law.c", "hume_left_knee.c"]
    command = [*ARM, *STRICT, "-ffp-contract=off", "-I.", *link, *both, "-lm"]
    result = subprocess.run(command, cwd=firmware, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return firmware / name


def test_the_interrupt_compiles_for_a_cortex_m4f_and_computes_in_its_own_registers(firmware: Path) -> None:
    need("arm-none-eabi-gcc", PACKAGES)
    sources = ["joint_law.c", "hume_left_knee.c", EXAMPLE / "torque_loop.c"]
    subprocess.run([*ARM, *STRICT, "-ffp-contract=off", "-I.", "-c", *sources], cwd=firmware, check=True)
    undefined = run(["arm-none-eabi-nm", "-u", *(firmware / f"{s}.o" for s in ("joint_law", "torque_loop"))], "")
    called = set(re.findall(r"U (\w+)", undefined))
    own = {"joint_law_init", "joint_law_step", "joint_law_use", "hume_left_knee", "hume_left_knee_stance"}
    assert called <= {"floorf", "memcpy", "memset", *own}  # no double precision in software: no __aeabi_d…


def test_a_cortex_m4f_computes_the_bits_of_this_processor(firmware: Path, recorded: dict[str, LawRecording]) -> None:
    """Another instruction set, another compiler, another C library."""
    text = rows(recorded["left_knee"])
    elf = program(firmware, "example.elf", "main.c")
    theirs = numbers(run([*QEMU, "-kernel", elf], text), "single")
    assert same_bits(numbers(run([build(firmware, "-O2")], text), "single"), theirs) and len(theirs) == 3000


def test_a_step_takes_a_small_part_of_the_interrupt_s_period(firmware: Path) -> None:
    """Instructions, counted by QEMU. On a Cortex-M4F a division takes 14 cycles, a jump or a load 3 at most, all from
    memory that does not let it wait; single operations take 1."""
    elf = program(firmware, "count.elf", EXAMPLE / "count.c")
    instructions = float(run([*QEMU, "-icount", "shift=10", "-kernel", elf], ""))
    counted = LAW.program.counted
    assert sum(counted.values()) < instructions < 5 * sum(counted.values())
    assert 3 * instructions + 14 * counted["divisions"] < 170e6 / 3000 / 4


def test_the_interrupt_passes_on_what_the_law_says(firmware: Path) -> None:
    """The example's own lines, on this processor: registers are variables, the demand goes out scaled and only if power
    is permitted. The spring holds what is commanded, the measured current is the demanded one."""
    need("cc", "gcc libc6-dev")
    source = (EXAMPLE / "torque_loop.c").read_text()
    source = re.sub(r"REGISTER\(0x(\w+)\)", r"&register_\1", source)
    names = sorted(set(re.findall(r"&register_(\w+)", source)))
    assert len(names) == 10
    declared = "#include <stdint.h>\n" + "".join(f"static volatile uint32_t register_{n};\n" for n in names)
    joint = HUME.joint("left_knee")
    spring = round(20.0 / joint.sensor.torque_resolution)
    motor, absolute = -20000, round((-20000 / joint.sensor.encoder - spring / joint.spring_counts_per_rad)
                                    * joint.sensor.joint_encoder)  # fmt: skip
    main = f"""
#include <stdio.h>
int main(void)
{{
    int permitted, k;
    torque_loop_init();
    register_40000024 = (uint32_t)({motor}); register_40000C24 = (uint32_t)({spring});
    register_40003C0C = (uint32_t)({absolute}); register_50000084 = 4800 / 2; register_50000088 = 250;
    register_40001024 = 9; register_50000808 = 2048;
    for (permitted = 0; permitted < 2; permitted++) {{
        torque_loop_command(permitted, 20, 500);
        for (k = 0; k < 300; k++) {{
            register_50000080 = register_50000808;
            TIM6_DAC_IRQHandler();
        }}
        printf("%u %u\\n", (unsigned)register_50000808, (unsigned)register_48000418);
    }}
    return 0;
}}
"""
    (firmware / "host.c").write_text(declared + source + main)
    command = ["cc", "-std=c99", "-I.", "-ffp-contract=off", "-o", "host"]
    subprocess.run([*command, "host.c", "joint_law.c", "hume_left_knee.c", "-lm"], cwd=firmware, check=True)
    off, on = (line.split() for line in run([firmware / "host"], "").splitlines())
    (firmware / "host.c").unlink()
    assert off == ["2048", str(1 << 16)]
    dac, enable = map(int, on)
    torque = spring * joint.sensor.torque_resolution
    assert enable == 1 and (dac - 2048) * 0.02 == pytest.approx((20 + 3 * (20 - torque)) / 6.1, abs=0.02)
