#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <time.h>

static int64_t begun_ns, spin_ns, stood_ns;

void clock_begin(int64_t spin_us)
{
    spin_ns = spin_us * 1000;
    begun_ns = clock_monotonic_ns();
}

int64_t clock_begun_ns(void)
{
    return begun_ns;
}

int64_t clock_monotonic_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

int64_t clock_now_us(void)
{
    return (clock_monotonic_ns() - begun_ns) / 1000;
}

void clock_stand_at(int64_t t_us)
{
    const int64_t begun_at_least_ns = clock_monotonic_ns() - t_us * 1000;
    if (begun_at_least_ns > begun_ns) {
        stood_ns += begun_at_least_ns - begun_ns;
        begun_ns = begun_at_least_ns;
    }
}

int64_t clock_stood_us(void)
{
    return stood_ns / 1000;
}

void clock_wait_until(int64_t t_us)
{
    const int64_t end_ns = begun_ns + t_us * 1000, wake_ns = end_ns - spin_ns;
    if (clock_monotonic_ns() < wake_ns) {
        const struct timespec wake = {wake_ns / 1000000000, wake_ns % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &wake, 0) == EINTR) {
        }
    }
    while (clock_monotonic_ns() < end_ns)
        clock_relax();
}
