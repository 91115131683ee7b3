/* Start-up of a Cortex-M, and a port that talks to a debugger or an emulator by semihosting.
   For a board of yours: its own start-up, clocks and linker script take the place of this file and of mps2.ld. */
#include <stddef.h>
#include <stdint.h>

extern uint32_t data_from, data_begin, data_end, bss_begin, bss_end, stack_top;
int main(void);

/* What a compiler calls for copies of structs; a C library's take their place. */
#define PLAIN_LOOP __attribute__((weak, optimize("no-tree-loop-distribute-patterns")))

PLAIN_LOOP void *memcpy(void *to, const void *from, size_t size)
{
    for (size_t n = 0; n < size; n++)
        ((uint8_t *)to)[n] = ((const uint8_t *)from)[n];
    return to;
}

PLAIN_LOOP void *memset(void *to, int value, size_t size)
{
    for (size_t n = 0; n < size; n++)
        ((uint8_t *)to)[n] = (uint8_t)value;
    return to;
}

int port_semihosting(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

void port_print(const char *line)
{
    port_semihosting(4, line); /* SYS_WRITE0 */
    port_semihosting(4, "\n");
}

void port_exit(int code)
{
    const uint32_t ended[2] = {0x20026, (uint32_t)code}; /* ADP_Stopped_ApplicationExit */
    port_semihosting(0x20, ended); /* SYS_EXIT_EXTENDED */
    for (;;) {
    }
}

void start(void)
{
    *(volatile uint32_t *)0xe000ed88 |= 0xfu << 20; /* CPACR: the floating-point unit, with its defaults: no flush */
    __asm__ volatile("dsb\n\tisb");
    for (uint32_t *to = &data_begin, *from = &data_from; to < &data_end;)
        *to++ = *from++;
    for (uint32_t *to = &bss_begin; to < &bss_end;)
        *to++ = 0;
    port_exit(main());
}

static void stop(void)
{
    port_print("pkxyz: the processor stopped on a fault");
    port_exit(3);
}

/* Of the board's own interrupts the first is somebody's who defines it. */
__attribute__((weak)) void interrupt_0(void)
{
    stop();
}

__attribute__((section(".vectors"), used)) static const void *const vectors[17] = {
    &stack_top, (const void *)start, (const void *)stop, (const void *)stop, (const void *)stop, (const void *)stop,
    (const void *)stop, [16] = (const void *)interrupt_0,
};
