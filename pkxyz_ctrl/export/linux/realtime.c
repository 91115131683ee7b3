#define _GNU_SOURCE
#include "realtime.h"

#include <sched.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <errno.h>
#include <fcntl.h>
#include <unistd.h>
#include <sys/mman.h>
#include <sys/prctl.h>

enum { WORDS = 320 };

static int awake = -1; /* while it is open, no core falls asleep: whom a frame wakes is there some microseconds earlier */

/* One more of several things, with what stands between two of them. */
static void add(char *list, const char *between, const char *format, ...)
{
    const size_t length = strlen(list);
    va_list values;
    va_start(values, format);
    const int begun = snprintf(list + length, WORDS - length, "%s", length ? between : "");
    vsnprintf(list + length + begun, WORDS - length - (size_t)begun, format, values);
    va_end(values);
}

/* Linux, PM QoS: no latency of a core's waking is borne. Whether it was permitted. */
static int keep_cores_awake(void)
{
    const int32_t most_us = 0;
    awake = open("/dev/cpu_dma_latency", O_WRONLY | O_CLOEXEC);
    return awake >= 0 && write(awake, &most_us, sizeof most_us) == sizeof most_us;
}

void go_real_time(int priority, char *said, int size)
{
    char have[WORDS] = "", lack[WORDS] = "";
    const struct sched_param wanted = {.sched_priority = priority};
    if (sched_setscheduler(0, SCHED_FIFO, &wanted) == 0)
        add(have, ", ", "SCHED_FIFO %d", priority);
    else
        add(lack, "; ", "SCHED_FIFO (needs CAP_SYS_NICE or an rtprio limit in /etc/security/limits.conf)");
    if (mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0)
        add(have, ", ", "memory locked");
    else
        add(lack, "; ", "locked memory (%s; needs CAP_IPC_LOCK or a memlock limit)", strerror(errno));
    if (prctl(PR_SET_TIMERSLACK, 1) != 0)
        add(lack, "; ", "timer slack");
    if (keep_cores_awake())
        add(have, ", ", "cores awake");
    else
        add(lack, "; ", "cores awake (%s; needs write access to /dev/cpu_dma_latency)", strerror(errno));
    snprintf(said, (size_t)size, "real time: %s%s%s%s", *have ? have : "nothing", *lack ? "; not permitted: " : "", lack,
             *lack ? "; the loop runs all the same, later now and then" : "");
}

void leave_real_time(void)
{
    const struct sched_param ordinary = {0};
    sched_setscheduler(0, SCHED_OTHER, &ordinary);
    if (awake >= 0)
        close(awake);
    awake = -1;
}
