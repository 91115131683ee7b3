/* orders.c with nothing around it but what a test says of the controller: for ctypes. */
#include "clock.h"
#include "controller.h"
#include "ending.h"
#include "orders.h"

static int mode, asked, requested, waits, looks_after;
static int64_t now_us;
static pkxyz_shared *shared;

/* A clock that passes where it is waited for, and a session that looks after so many waits. */
int64_t clock_now_us(void) { return now_us; }
void clock_stand_at(int64_t t_us) { now_us = t_us; }
void clock_wait_until(int64_t t_us)
{
    now_us = t_us;
    if (++waits == looks_after)
        shared->operated->looked = shared->operated->newest;
}

int controller_mode(void) { return mode; }
int controller_is_closed(void) { return mode == PKXYZ_MODE_TRACKING; }
void controller_request(int event) { requested = event; }
void controller_clear(void) {}
void controller_change_law(const pkxyz_law_change_change *change) { (void)change; }
void ending_ask(int outcome) { asked = outcome; }

void alone_begin(pkxyz_shared *with)
{
    shared = with;
    mode = asked = requested = waits = looks_after = 0;
    now_us = 0;
    orders_begin(with, -1);
}
int alone_awaited(int looks)
{
    waits = 0;
    looks_after = looks;
    orders_await();
    return now_us == 0 ? waits : -1; /* -1: time has passed */
}
void alone_mode(int is) { mode = is; }
int alone_asked(void) { return asked; }
int alone_requested(void) { return requested; }
