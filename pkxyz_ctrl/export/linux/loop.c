#define _GNU_SOURCE
#include "loop.h"

#include <time.h>

#include "clock.h"
#include "controller.h"
#include "ending.h"
#include "orders.h"
#include "path.h"
#include "port.h"
#include "realtime.h"
#include "ring.h"
#include "ticks.h"

enum { POLL_US = 1000, LANDED_TICKS = 2, LOOK_US = 20000, LAST_FRAMES_US = 20000, STANDS_US = 100 };
enum { KERNEL_EIGHTHS = 5 }; /* of a period: what it does then delays neither an answer nor what comes next */
enum { UNPOLLED_MOST_US = 20000 }; /* of a start-up in which frame after frame comes, none of them the one awaited */

/* Until somebody else is on the bus, where that is known: a plant that was begun in the same moment takes a while. */
static void wait_for_others(const pkxyz_shared_settings *settings, pkxyz_shared_state *state)
{
    const int64_t end_us = clock_now_us() + settings->company_us;
    while (state->port->others == 0 && clock_now_us() < end_us && !ending_asked()) {
        state->phase = PKXYZ_PHASE_ALONE;
        clock_wait_until(clock_now_us() + LOOK_US);
        port_look();
    }
}

static int start_up(void)
{
    frame came;
    int64_t polled_us = clock_now_us();
    controller_start(polled_us);
    for (;;) {
        if (ending_asked())
            return ending_asked();
        port_look();
        const int is_there = port_receive(clock_now_us() + POLL_US, &came);
        ring_hand_over();
        const int64_t now_us = clock_now_us();
        int up = 0;
        if (!is_there || now_us - polled_us > UNPOLLED_MOST_US) {
            polled_us = now_us;
            up = controller_come_up(0, now_us);
        }
        if (is_there && up == 0)
            up = controller_come_up(&came, clock_now_us());
        if (up != 0)
            return up > 0 ? PKXYZ_OUTCOME_NONE : PKXYZ_OUTCOME_NOT_STARTED;
    }
}

static int is_amplifier_gone(const pkxyz_shared_settings *settings, const pkxyz_shared_state *state)
{
    return controller_mode() == PKXYZ_MODE_FAULT && clock_now_us() - state->heartbeat_us > settings->silent_us;
}

/* Whether the frame that is awaited came by then. Other frames do not put that off, however many there are. */
static int take_until(int64_t deadline_us)
{
    frame came;
    while (port_receive(deadline_us, &came)) {
        if (controller_take(&came, clock_now_us()))
            return 1;
        if (clock_now_us() > deadline_us)
            break;
    }
    return 0;
}

/* An amplifier that is simulated beside us is waited for, unless it did not answer the last time: time stands still
   before the deadline, for so long and no longer. */
static void await(const pkxyz_shared_settings *settings, int64_t deadline_us)
{
    static int has_answered = 1;
    int came = take_until(deadline_us);
    for (int64_t stood_us = 0; !came && has_answered && stood_us < settings->standstill_us; stood_us += STANDS_US) {
        clock_stand_at(deadline_us - STANDS_US);
        came = take_until(deadline_us);
    }
    has_answered = came;
}

/* One period that begins at t_us. */
static void exchange(const pkxyz_shared_settings *settings, const pkxyz_reference *rows, int32_t rows_count, int64_t t_us,
                     int32_t overrun)
{
    controller_sync(t_us);
    controller_rehearse(rows, rows_count);
    await(settings, t_us + settings->sense_deadline_us);
    if (settings->is_operated) {
        orders_await();
        orders_take(&rows, &rows_count);
    }
    controller_compute(rows, rows_count, overrun);
    ticks_computed(t_us);
    controller_finish(clock_now_us(), t_us + settings->heartbeat_deadline_us);
}

/* Deadlines are absolute: a tick that begins late shifts no other, and ticks that are past are skipped whole. */
static int run(pkxyz_shared *shared)
{
    static const pkxyz_reference still;
    const pkxyz_shared_settings *settings = shared->settings;
    pkxyz_shared_state *state = shared->state;
    const pkxyz_exchange_memory *memory = shared->memory->own;
    const pkxyz_reference *rows = &still;
    const int64_t period_us = settings->period_us, ticks = settings->ticks + settings->landing_ticks + LANDED_TICKS;
    int32_t rows_count = 1;
    int64_t t_us = clock_beside_kernel(clock_now_us() + period_us, period_us, period_us * KERNEL_EIGHTHS / 8);
    for (int64_t tick = 0; tick < ticks; tick++, t_us += period_us) {
        if (!settings->is_operated && !path_at(memory->cycle->reference_tick, &rows, &rows_count))
            ending_ask(PKXYZ_OUTCOME_PATH_LATE);
        ending_look();
        if (!ticks_wait_until(t_us))
            return ending_asked();
        const int64_t skipped = (clock_now_us() - t_us) / period_us;
        t_us += skipped * period_us;
        exchange(settings, rows, rows_count, t_us, (int32_t)skipped);
        if (controller_status() != 0)
            return PKXYZ_OUTCOME_KERNEL;
        if (tick < settings->ticks)
            ring_row(&memory->cycle->row);
        if (tick == settings->ticks - 1 && controller_is_closed())
            controller_request(PKXYZ_EVENT_DISABLE);
        state->ticks = tick + 1;
        state->stood_us = clock_stood_us();
        state->reference_tick = memory->cycle->reference_tick;
        if (settings->is_operated)
            orders_leave();
        else if (is_amplifier_gone(settings, state)) /* one that is operated may be cleared */
            return PKXYZ_OUTCOME_AMPLIFIER_GONE;
    }
    return PKXYZ_OUTCOME_DONE;
}

int loop(pkxyz_shared *shared)
{
    const pkxyz_shared_settings *settings = shared->settings;
    pkxyz_shared_state *state = shared->state;
    wait_for_others(settings, state);
    int outcome = ending_asked();
    if (outcome != 0)
        return outcome;
    clock_find_kernel();
    go_real_time(settings->priority, (char *)state->real_time, sizeof state->real_time);
    controller_warm_up();
    state->phase = PKXYZ_PHASE_STARTING;
    outcome = start_up();
    if (outcome == PKXYZ_OUTCOME_NONE) {
        state->phase = PKXYZ_PHASE_RUNNING;
        outcome = run(shared);
    }
    clock_wait_until(clock_now_us() + settings->guard_us); /* or the gate calls it a babbling node */
    controller_stop(clock_now_us());
    clock_wait_until(clock_now_us() + LAST_FRAMES_US); /* they leave even a slow adapter before it is closed */
    leave_real_time();
    return outcome;
}
