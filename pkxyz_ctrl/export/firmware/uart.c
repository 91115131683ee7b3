/* ARM's CMSDK UART 0 of the MPS2 boards. What comes is taken by interrupt into a ring, what goes waits for its place. */
#include "uart.h"

#include <stdint.h>

#define UART_DATA (*(volatile uint32_t *)0x40004000)
#define UART_STATE (*(volatile uint32_t *)0x40004004)
#define UART_CONTROL (*(volatile uint32_t *)0x40004008)
#define UART_INTERRUPT (*(volatile uint32_t *)0x4000400c)
#define UART_DIVIDER (*(volatile uint32_t *)0x40004010)
#define NVIC_ENABLE (*(volatile uint32_t *)0xe000e100)

enum { TRANSMIT_FULL = 1, RECEIVE_FULL = 2 };                    /* of the state */
enum { TRANSMIT_ON = 1, RECEIVE_ON = 2, RECEIVE_INTERRUPT = 8 }; /* of the control */
enum { RECEIVED = 2 };                                           /* of the interrupts */
enum { RING = 1024 };                                            /* above the length of any answer */

static volatile char ring[RING];
static volatile uint32_t put_at, got_at;

void interrupt_0(void)
{
    UART_INTERRUPT = RECEIVED;
    while (UART_STATE & RECEIVE_FULL)
        ring[put_at++ % RING] = (char)UART_DATA;
}

void uart_open(void)
{
    UART_DIVIDER = 16; /* as fast as it goes */
    UART_CONTROL = TRANSMIT_ON | RECEIVE_ON | RECEIVE_INTERRUPT;
    NVIC_ENABLE = 1;
}

void uart_put(char character)
{
    while (UART_STATE & TRANSMIT_FULL) {
    }
    UART_DATA = (uint8_t)character;
}

char uart_get(void)
{
    /* Interrupts are held back between the look and the sleep, which they end all the same: none is slept through. */
    while (put_at == got_at) {
        __asm__ volatile("cpsid i" ::: "memory");
        if (put_at == got_at)
            __asm__ volatile("dsb\n\twfi" ::: "memory");
        __asm__ volatile("cpsie i\n\tisb" ::: "memory");
    }
    return ring[got_at++ % RING];
}
