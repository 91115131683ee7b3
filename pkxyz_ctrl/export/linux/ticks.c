#include "ticks.h"

#include "clock.h"
#include "controller.h"
#include "ending.h"
#include "port.h"

static const pkxyz_shared_settings *settings;
static pkxyz_shared_state *state;

void ticks_begin(const pkxyz_shared_settings *given, pkxyz_shared_state *said)
{
    settings = given;
    state = said;
}

/* Between two ticks: is it time to go? Not before the stage has been led down. */
static int is_over(void)
{
    if (!ending_asked())
        return 0;
    if (controller_is_closed()) {
        controller_request(PKXYZ_EVENT_DISABLE);
        return 0;
    }
    return controller_mode() != PKXYZ_MODE_LANDING;
}

/* What came after a tick had given up waiting, as far as there is time for it: on a flooded bus there is always more.
   Otherwise one sense frame that was late would leave every later one to be taken a tick too late. */
static void take_late_frames(int64_t until_us)
{
    frame came;
    while (clock_now_us() < until_us && port_receive(0, &came))
        controller_take(&came, clock_now_us());
}

int ticks_wait_until(int64_t t_us)
{
    for (;;) {
        if (is_over())
            return 0;
        const int64_t behind_us = clock_now_us() + settings->guard_us - t_us;
        if (behind_us > 0 && behind_us <= settings->standstill_us)
            clock_stand_at(t_us - settings->guard_us);
        else if (behind_us > 0)
            t_us += (behind_us + settings->period_us - 1) / settings->period_us * settings->period_us;
        const int64_t last_look_us = t_us - settings->guard_us / 2;
        port_look();
        take_late_frames(last_look_us);
        clock_wait_until(last_look_us);
        take_late_frames(t_us); /* what comes later than this came in a tick of its own */
        clock_wait_until(t_us);
        const int64_t late_us = clock_now_us() - t_us;
        clock_count(state->lateness, PKXYZ_HISTOGRAM_US, late_us);
        if (late_us > settings->latest_start_us && late_us <= settings->standstill_us)
            clock_stand_at(t_us);
        else if (late_us > settings->latest_start_us)
            continue;
        return 1;
    }
}

void ticks_computed(int64_t t_us)
{
    const int64_t at_latest_us = t_us + settings->period_us - 2 * settings->guard_us;
    if (clock_now_us() < at_latest_us + settings->standstill_us)
        clock_stand_at(at_latest_us);
}
