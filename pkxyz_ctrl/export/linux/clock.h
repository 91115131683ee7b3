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

/* When does the kernel do what it does a hundred or a thousand times a second? It takes some 20 us of a virtual core, and
   a loop whose period divides that time meets it every time at the same place: at 5 kHz in every fiftieth tick. Takes
   some of these times to find out. */
void clock_find_kernel(void);

/* The first instant from t_us on for which that is late_us, of period_us, past it; t_us where they do not go together. */
int64_t clock_beside_kernel(int64_t t_us, int64_t period_us, int64_t late_us);

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
