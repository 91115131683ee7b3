#include "stopwatch.h"

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xe000e010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xe000e014)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xe000e018)

enum { COUNTS = 0xffffff };

static uint32_t sum, begin, is_going;

void stopwatch_open(void)
{
    SYSTICK_RELOAD = COUNTS;
    SYSTICK_CONTROL = 1 | 4; /* counts down, with the processor's clock */
}

static uint32_t since_begin(void)
{
    return (begin - SYSTICK_VALUE) & COUNTS;
}

void stopwatch_start(void)
{
    sum = 0;
    stopwatch_go_on();
}

void stopwatch_go_on(void)
{
    is_going = 1;
    begin = SYSTICK_VALUE;
}

void stopwatch_pause(void)
{
    if (is_going)
        sum += since_begin();
    is_going = 0;
}

uint32_t stopwatch(void)
{
    return sum + (is_going ? since_begin() : 0);
}
