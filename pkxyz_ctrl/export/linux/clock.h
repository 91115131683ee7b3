/* The loop's clock: microseconds of CLOCK_MONOTONIC since clock_begin, less those for which it stood still. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

void clock_begin(int64_t spin_us);
int64_t clock_begun_ns(void); /* where it is 0 */
int64_t clock_monotonic_ns(void);
int64_t clock_now_us(void);

/* Returns at t_us, or at once if that is past: sleeps until shortly before it, then looks again and again. */
void clock_wait_until(int64_t t_us);

/* It is t_us again, where it has become later. */
void clock_stand_at(int64_t t_us);
int64_t clock_stood_us(void); /* in all */

/* One more of time_us in a histogram by whole us, whose last entry has all beyond. */
static inline void clock_count(int64_t *histogram, int64_t size, int64_t time_us)
{
    histogram[time_us < size ? time_us : size - 1]++;
}

/* Between two looks at something that may change at any moment. */
static inline void clock_relax(void)
{
#if defined __x86_64__ || defined __i386__
    __builtin_ia32_pause();
#endif
}

#endif
