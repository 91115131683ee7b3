/* The loop's clock beside the kernel's own work. Words: a period in us and by how much late. Says the kernel's period in ns,
   and for some times in us when the tick begins instead, and how much past that the kernel works next, in ns. */
#include "../../pkxyz_ctrl/export/linux/clock.c"

#include <stdio.h>
#include <stdlib.h>

int main(int count, char **words)
{
    const int64_t period_us = count > 2 ? atoll(words[1]) : 0, late_us = count > 2 ? atoll(words[2]) : 0;
    clock_begin(60);
    clock_find_kernel();
    printf("%lld\n", (long long)kernel_period_ns);
    for (int64_t t_us = 1000; period_us > 0 && t_us < 1000 + 3 * period_us; t_us += 37) {
        const int64_t begins_us = clock_beside_kernel(t_us, period_us, late_us);
        const int64_t past_ns = (kernel_ns - begun_ns - begins_us * 1000) % (period_us * 1000);
        printf("%lld %lld %lld\n", (long long)t_us, (long long)begins_us, (long long)(past_ns < 0 ? past_ns + period_us * 1000 : past_ns));
    }
    return period_us > 0 ? 0 : 2;
}
