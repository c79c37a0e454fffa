/* 3 kHz torque loop of Hume's left knee on an STM32G4 (Cortex-M4F): the interrupt that calls the exported law.
 *
 * Export first: hil export --robot hume --joint left_knee --precision single --out firmware
 * Addresses are those of the STM32G474 (RM0440). Clocks, pins, timers and ADC are to be set up elsewhere; state machine
 * and watchdog, which decide whether power may flow, run at a lower priority.
 */
#include "joint_law.h"

#define REGISTER(address) ((volatile uint32_t *)(address))

static const struct {
    volatile const uint32_t *motor_encoder;  /* TIM2->CNT: 32 bit, encoder mode */
    volatile const uint32_t *spring_encoder; /* TIM5->CNT: 32 bit, encoder mode */
    volatile const uint32_t *current;        /* ADC1->JDR1: 12 bit, offset binary, started by TIM6's trigger */
    volatile const uint32_t *supply;         /* ADC1->JDR2: 12 bit */
    volatile const uint32_t *temperature;    /* ADC1->JDR3: 12 bit */
    volatile const uint32_t *joint_encoder;  /* SPI3->DR: absolute, its transfer started by the same trigger */
    volatile uint32_t *demand;               /* DAC1->DHR12R1: set-point of the power stage's current loop */
    volatile uint32_t *enable;               /* GPIOB->BSRR: pin 0 switches the power stage */
    volatile uint32_t *timer_status;         /* TIM6->SR: the timer whose update is this interrupt */
    volatile const uint32_t *timer;          /* TIM6->CNT: us since the update */
} hw = {
    REGISTER(0x40000024), REGISTER(0x40000C24), REGISTER(0x50000080), REGISTER(0x50000084), REGISTER(0x50000088),
    REGISTER(0x40003C0C), REGISTER(0x50000808), REGISTER(0x48000418), REGISTER(0x40001010), REGISTER(0x40001024),
};

#define MIDSCALE 2048
#define ADC_UNITS 2  /* of 0.01 A per count of the ADC: a 20 mA/count sense amplifier, +-41 A */
#define DAC_UNITS 2  /* of 0.01 A per count of the DAC */
#define SUPPLY_UNITS 2       /* of 0.01 V per count of the ADC: a divider for 82 V */
#define TEMPERATURE_UNITS 1  /* of 0.1 K per count of the ADC, 0 at 0 degrees Celsius */
#define ENABLE_ON (1u << 0)
#define ENABLE_OFF (1u << 16)

static joint_law law;
static volatile int permitted; /* by the state machine */
static int32_t spent;          /* us that the last interrupt took */

void torque_loop_init(void)
{
    joint_law_init(&law, hume_left_knee);
    joint_law_use(&law, &hume_left_knee_stance);
}

/* Take over a command, with this interrupt masked: the law must not see half of one. */
void torque_loop_command(int power_permitted, joint_law_real torque, joint_law_real limit)
{
    law.u[JOINT_LAW_U_TORQUE] = torque;
    law.u[JOINT_LAW_U_LIMIT] = limit;
    law.u[JOINT_LAW_U_TORQUE_MODE] = law.u[JOINT_LAW_U_ENABLED] = power_permitted ? 1 : 0;
    permitted = power_permitted;
}

static uint32_t dac(int32_t demand)
{
    int32_t value = MIDSCALE + demand / DAC_UNITS;
    return (uint32_t)(value < 0 ? 0 : value > 4095 ? 4095 : value);
}

/* At 3 kHz, above all other priorities but a fault's. */
void TIM6_DAC_IRQHandler(void)
{
    int32_t counts[JOINT_LAW_COUNTS] = {0};

    *hw.timer_status = 0;
    counts[JOINT_LAW_COUNT_MOTOR_ENCODER] = (int32_t)*hw.motor_encoder;
    counts[JOINT_LAW_COUNT_SPRING_ENCODER] = (int32_t)*hw.spring_encoder;
    counts[JOINT_LAW_COUNT_CURRENT_ADC] = ((int32_t)*hw.current - MIDSCALE) * ADC_UNITS;
    counts[JOINT_LAW_COUNT_SUPPLY_ADC] = (int32_t)*hw.supply * SUPPLY_UNITS;
    counts[JOINT_LAW_COUNT_TEMPERATURE_ADC] = (int32_t)*hw.temperature * TEMPERATURE_UNITS;
    counts[JOINT_LAW_COUNT_JOINT_ENCODER] = (int32_t)*hw.joint_encoder;
    counts[JOINT_LAW_COUNT_ISR_TIMER] = spent;
    joint_law_step(&law, counts);
    *hw.demand = dac(permitted ? (int32_t)law.y[JOINT_LAW_Y_DEMAND] : 0);
    *hw.enable = permitted ? ENABLE_ON : ENABLE_OFF;
    spent = (int32_t)*hw.timer;
}
