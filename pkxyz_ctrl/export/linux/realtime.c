#define _GNU_SOURCE
#include "realtime.h"

#include <sched.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <errno.h>
#include <sys/mman.h>
#include <sys/prctl.h>

enum { WORDS = 240 };

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
    snprintf(said, (size_t)size, "real time: %s%s%s%s", *have ? have : "nothing", *lack ? "; not permitted: " : "", lack,
             *lack ? "; the loop runs all the same, later now and then" : "");
}

void leave_real_time(void)
{
    const struct sched_param ordinary = {0};
    sched_setscheduler(0, SCHED_OTHER, &ordinary);
}
