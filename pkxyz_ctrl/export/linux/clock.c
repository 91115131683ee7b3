#define _GNU_SOURCE
#include "clock.h"

#include <errno.h>
#include <time.h>

enum { LOOKS = 4, PERIOD_LEAST_NS = 100000 };

static int64_t begun_ns, spin_ns, stood_ns;
static int64_t kernel_ns, kernel_period_ns; /* one of its times, by CLOCK_MONOTONIC; 0: not known */

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

static int64_t ns_of(struct timespec time)
{
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

/* When the coarse clock, which the kernel sets then, is seen to move on; -1: it does not. */
static int64_t next_of_kernel_ns(void)
{
    struct timespec was, is;
    const int64_t end_ns = clock_monotonic_ns() + 4 * kernel_period_ns;
    clock_gettime(CLOCK_MONOTONIC_COARSE, &was);
    do {
        clock_gettime(CLOCK_MONOTONIC_COARSE, &is);
        if (clock_monotonic_ns() > end_ns)
            return -1;
    } while (ns_of(is) == ns_of(was));
    return clock_monotonic_ns();
}

/* Of what was seen, the earliest: who looks may himself be late. */
void clock_find_kernel(void)
{
    struct timespec period;
    if (clock_getres(CLOCK_MONOTONIC_COARSE, &period) != 0 || ns_of(period) < PERIOD_LEAST_NS)
        return;
    kernel_period_ns = ns_of(period);
    for (int look = 0; look < LOOKS; look++) {
        const int64_t seen_ns = next_of_kernel_ns();
        if (seen_ns < 0) {
            kernel_period_ns = 0;
            return;
        }
        const int64_t since_ns = look ? (seen_ns - kernel_ns) % kernel_period_ns : 0;
        const int64_t earlier_ns = since_ns > kernel_period_ns / 2 ? kernel_period_ns - since_ns : 0;
        kernel_ns = look ? kernel_ns - earlier_ns : seen_ns;
    }
}

int64_t clock_beside_kernel(int64_t t_us, int64_t period_us, int64_t late_us)
{
    const int64_t period_ns = period_us * 1000;
    if (kernel_period_ns == 0 || (kernel_period_ns % period_ns != 0 && period_ns % kernel_period_ns != 0))
        return t_us;
    const int64_t wanted_ns = kernel_ns - late_us * 1000 - begun_ns - t_us * 1000, over_ns = wanted_ns % period_ns;
    return t_us + (over_ns < 0 ? over_ns + period_ns : over_ns) / 1000;
}
