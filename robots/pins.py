"""The I/O pins between an actuator's electronics and its DSP: integers, as a DSP sees them.

The plant's sensor models write the input pins and read the output pins; the firmware does the reverse.
"""

# Input pins (plant → firmware), int32 each.
MOTOR_ENCODER = 0  # counts, incremental
SPRING_ENCODER = 1  # counts of spring deflection
CURRENT_ADC = 2  # measured motor current
TEMPERATURE_ADC = 3  # winding temperature
SUPPLY_ADC = 4  # supply voltage
SWITCHES = 5  # bit 0: foot contact switch (knee DSPs only)
N_INPUTS = 6

# Output pins (firmware → plant), int32 each.
CURRENT_DEMAND = 0
ENABLE = 1  # 1: power stage on
N_OUTPUTS = 2

FOOT_SWITCH = 1 << 0

# Scales that are wired into the electronics of every drive.
AMPERE_PER_COUNT = 0.01
KELVIN_PER_COUNT = 0.1  # temperature in °C
VOLT_PER_COUNT = 0.01
