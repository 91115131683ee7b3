/* The loop's clock: microseconds of CLOCK_MONOTONIC since clock_begin. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

void clock_begin(int64_t spin_us);
int64_t clock_begun_ns(void);
int64_t clock_monotonic_ns(void);
int64_t clock_now_us(void);

/* Returns at t_us, or at once if that is past: sleeps until shortly before it, then looks again and again. */
void clock_wait_until(int64_t t_us);

/* Between two looks at something that may change at any moment. */
static inline void clock_relax(void)
{
#if defined __x86_64__ || defined __i386__
    __builtin_ia32_pause();
#endif
}

#endif
