#define _GNU_SOURCE
#include "orders.h"

#include <stdatomic.h>
#include <string.h>
#include <unistd.h>

#include "clock.h"
#include "controller.h"
#include "ending.h"

enum { LOOKED_AHEAD = 2 }; /* rows, behind the delay */
enum { STANDS_US = 50 };

static pkxyz_shared *shared;
static const pkxyz_shared_sheet *sheet;
static pkxyz_shared_obeyed obeyed;
static int wake_descriptor = -1, has_looked = 1;

void orders_begin(pkxyz_shared *with, int wake)
{
    shared = with;
    wake_descriptor = wake;
    sheet = 0;
    has_looked = 1;
    obeyed = (pkxyz_shared_obeyed){0};
}

/* The first row of the set-points that the law has not seen. */
static int64_t free_row(void)
{
    return shared->memory->own->cycle->reference_tick + shared->config->own->law->tick.delay_periods + LOOKED_AHEAD;
}

static int is_in_time(const pkxyz_shared_orders *orders)
{
    obeyed.late_rows = free_row() - orders->changed_from;
    if (obeyed.late_rows <= 0 || controller_mode() != PKXYZ_MODE_TRACKING)
        return 1;
    obeyed.refusals++;
    return 0;
}

static void take_outputs(const pkxyz_shared_orders *orders)
{
    pkxyz_outputs *outputs = shared->memory->own->outputs;
    pkxyz_outputs_position_trigger *trigger = &outputs->trigger;
    if (orders->bits & PKXYZ_ORDER_SETTLE) {
        outputs->window_m = orders->window_m;
        outputs->sigmas = orders->sigmas;
        outputs->dwell_ticks = orders->dwell_ticks;
    }
    if (orders->bits & PKXYZ_ORDER_AIM) {
        trigger->begun = 0;
        trigger->axis = orders->axis;
        trigger->direction = orders->direction;
        trigger->start_m = orders->start_m;
        trigger->pitch_m = orders->pitch_m;
        trigger->count = orders->count;
    }
}

static void obey(const pkxyz_shared_orders *orders)
{
    pkxyz_exchange_memory *memory = shared->memory->own;
    obeyed.refused = 0;
    if (orders->bits & PKXYZ_ORDER_SHEET) {
        if (is_in_time(orders))
            sheet = &shared->operated->sheets[orders->sheet & 1];
        else
            obeyed.refused |= PKXYZ_ORDER_SHEET;
    }
    if (orders->bits & PKXYZ_ORDER_LAW) {
        if (memory->cycle->tick_index <= orders->tick + 1)
            controller_change_law(shared->operated->change);
        else
            obeyed.refused |= PKXYZ_ORDER_LAW;
    }
    if (orders->bits & PKXYZ_ORDER_REQUEST && memory->event == 0) /* what the loop asks for itself goes first */
        controller_request(orders->event);
    if (orders->bits & PKXYZ_ORDER_CLEAR)
        controller_clear();
    if (orders->bits & PKXYZ_ORDER_RELEASE)
        memory->cycle->input.trips |= PKXYZ_TRIP_OPERATOR;
    if (orders->bits & PKXYZ_ORDER_QUIET)
        memory->cycle->input.quiet = orders->quiet;
    take_outputs(orders);
}

/* How many ticks the session has not looked at yet. */
static int64_t unseen(void)
{
    const pkxyz_shared_operated *operated = shared->operated;
    return operated->newest - atomic_load_explicit((const _Atomic int64_t *)&operated->looked, memory_order_acquire);
}

/* Whether nobody could stop or release the stage any more: whoever would is there, but looks at nothing. */
static int is_alone(void)
{
    return controller_is_closed() && unseen() > shared->settings->blind_ticks;
}

void orders_await(void)
{
    const int64_t now_us = clock_now_us(), most_us = shared->settings->standstill_us;
    for (int64_t stood_us = 0; unseen() > 0 && has_looked && stood_us < most_us; stood_us += STANDS_US) {
        clock_wait_until(now_us + STANDS_US);
        clock_stand_at(now_us);
    }
    has_looked = unseen() == 0;
}

/* Whether the law finds every row of this tick that it looks at, or the set-point stands behind the last one. */
static int reaches(int64_t count)
{
    const pkxyz_tick_law *law = &shared->config->own->law->tick;
    const int64_t last = sheet->first + count - 1, planned = law->kind == PKXYZ_PREDICTIVE ? law->predictive.horizon - 1 : 0;
    return last >= free_row() + planned || sheet->rests_from <= last;
}

void orders_take(const pkxyz_reference **rows, int32_t *count)
{
    const pkxyz_shared_orders *orders = shared->operated->orders;
    const int64_t number = atomic_load_explicit((const _Atomic int64_t *)&orders->number, memory_order_acquire);
    if (number != obeyed.number) {
        obey(orders);
        obeyed.number = number;
    }
    if (is_alone())
        ending_ask(PKXYZ_OUTCOME_SESSION_GONE); /* which leads it down */
    if (!sheet)
        return;
    const int64_t known = atomic_load_explicit((const _Atomic int64_t *)&sheet->count, memory_order_acquire);
    *rows = sheet->rows;
    *count = (int32_t)known;
    if (controller_mode() == PKXYZ_MODE_TRACKING && !reaches(known)) {
        ending_ask(PKXYZ_OUTCOME_SET_POINTS_LATE);
        controller_request(PKXYZ_EVENT_DISABLE);
    }
}

void orders_leave(void)
{
    static const uint64_t one = 1;
    pkxyz_shared_operated *operated = shared->operated;
    const int64_t number = operated->newest + 1;
    pkxyz_shared_snapshot *snapshot = &operated->snapshots[number % PKXYZ_SNAPSHOTS];
    atomic_store_explicit((_Atomic int64_t *)&snapshot->begun, number, memory_order_relaxed);
    atomic_thread_fence(memory_order_release); /* whoever sees any of what follows sees that it was begun */
    *snapshot->obeyed = obeyed; /* with the tick that they acted in, and not before */
    *snapshot->port = *shared->state->port;
    memcpy(snapshot->memory, shared->memory->own, sizeof *snapshot->memory);
    atomic_store_explicit((_Atomic int64_t *)&snapshot->number, number, memory_order_release);
    atomic_store_explicit((_Atomic int64_t *)&operated->newest, number, memory_order_release);
    if (wake_descriptor >= 0 && write(wake_descriptor, &one, sizeof one) < 0)
        wake_descriptor = -1; /* nobody will miss it: he looks by himself now and then */
}
