/* Prints how many instructions one step takes, measured in QEMU with -icount shift=10: there an instruction takes
 * 1024 ns of the timer's time. The law runs in torque mode, on counts that change.
 */
#include "joint_law.h"

#include <stdio.h>

#define SYST_CSR (*(volatile uint32_t *)0xE000E010)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018)
#define TIMER_HZ 25e6
#define INSTRUCTION_S 1024e-9
#define STEPS 100

static joint_law law;

__attribute__((noinline)) static uint32_t timed(int steps, void (*step)(joint_law *, const int32_t *))
{
    static int32_t counts[JOINT_LAW_COUNTS];
    uint32_t spent = 0, before;
    int k;
    for (k = 0; k < steps; k++) {
        counts[JOINT_LAW_COUNT_MOTOR_ENCODER] = 37 * k;
        counts[JOINT_LAW_COUNT_SPRING_ENCODER] = 11 * (k % 17);
        before = SYST_CVR;
        step(&law, counts);
        spent += (before - SYST_CVR) & 0xFFFFFF;
    }
    return spent;
}

static void nothing(joint_law *unused, const int32_t *counts)
{
    (void)unused;
    (void)counts;
}

int main(void)
{
    uint32_t call, step;
    SYST_RVR = 0xFFFFFF;
    SYST_CVR = 0;
    SYST_CSR = 5; /* processor's clock, no interrupt */
    joint_law_init(&law, hume_left_knee);
    joint_law_use(&law, &hume_left_knee_stance);
    law.u[JOINT_LAW_U_TORQUE_MODE] = 1;
    law.u[JOINT_LAW_U_TORQUE] = 20;
    law.u[JOINT_LAW_U_LIMIT] = 500;
    call = timed(STEPS, nothing);
    step = timed(STEPS, joint_law_step);
    printf("%.1f\n", (step - call) / TIMER_HZ / INSTRUCTION_S / STEPS);
    return 0;
}
