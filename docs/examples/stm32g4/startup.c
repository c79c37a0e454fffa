/* Start of a program on QEMU's mps2-an386 (Cortex-M4F); its input and output go through semihosting. */
#include <stdint.h>

void stack_top(void); /* no function: the linker's word for the end of the memory */
void _start(void); /* newlib's, for semihosting */

void start(void);

void start(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* CPACR: FPU on */
    __asm__ volatile("dsb\n isb");
    _start();
}

static void stuck(void)
{
    for (;;)
        ;
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    stack_top, start, stuck, stuck, stuck, stuck, stuck, 0, 0, 0, 0, stuck, stuck, 0, stuck, stuck,
};
