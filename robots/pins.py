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
JOINT_ENCODER = 6  # counts, absolute
FORCE_ADC = 7  # load cell
ISR_TIMER = 8  # µs that the previous interrupt took, from the processor's own timer
N_INPUTS = 9

# Output pins (firmware → plant), int32 each.
CURRENT_DEMAND = 0  # of the motor, or of a hydraulic joint's valve
ENABLE = 1  # 1: power stage on
N_OUTPUTS = 2

FOOT_SWITCH = 1 << 0

# Scales that are wired into the electronics of every drive.
AMPERE_PER_COUNT = 0.01  # unless the actuator's description says otherwise
KELVIN_PER_COUNT = 0.1  # temperature in °C
VOLT_PER_COUNT = 0.01
