#define _GNU_SOURCE
#include "ending.h"

#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <unistd.h>

#include "pkxyz.h"

static volatile sig_atomic_t signal_number;
static int outcome, gone, recorder = -1;

static void note(int number)
{
    if (signal_number == 0)
        signal_number = number;
}

void ending_begin(int recorder_pipe, int is_operated)
{
    struct sigaction action = {.sa_handler = note, .sa_flags = SA_RESTART};
    const int numbers[] = {SIGINT, SIGTERM, SIGHUP};
    for (unsigned n = 0; n < sizeof numbers / sizeof *numbers; n++)
        sigaction(numbers[n], &action, 0);
    signal(SIGPIPE, SIG_IGN);
    recorder = recorder_pipe;
    gone = is_operated ? PKXYZ_OUTCOME_SESSION_GONE : PKXYZ_OUTCOME_RECORDER_GONE;
    if (recorder >= 0)
        prctl(PR_SET_PDEATHSIG, SIGTERM); /* whoever writes the summary is gone: the same as if he had asked for the end */
}

int ending_asked(void)
{
    if (signal_number)
        return PKXYZ_OUTCOME_SIGNAL;
    return outcome;
}

int ending_signal(void)
{
    return signal_number;
}

void ending_ask(int why)
{
    if (outcome == 0)
        outcome = why;
}

void ending_look(void)
{
    struct pollfd looked = {recorder, 0, 0};
    if (recorder >= 0 && outcome == 0 && poll(&looked, 1, 0) == 1 && looked.revents & POLLERR)
        outcome = gone;
}
