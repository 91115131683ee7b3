/* The loop: the amplifier is brought up, then periods at absolute times. What runtime.py is on a computer. */
#include "bus.h"
#include "debugger.h"
#include "notes.h"
#include "pkxyz.h"
#include "slcan.h"
#include "stopwatch.h"
#include "time_owner.h"
#include "uart.h"

enum { POLL_US = 1000, UNPOLLED_MOST_US = 20000 }; /* of a start-up in which frame after frame comes */
enum { SOMETHING_TO_SAY = 0x700, FRESH = 1 };      /* told by calls: refused, restarted, not restarted; a sample is in */

extern const uint64_t pkxyz_config_words[], pkxyz_path_words[], pkxyz_outputs_words[];
extern uint64_t pkxyz_memory_words[];
extern const int32_t pkxyz_path_words_count;

static const pkxyz_exchange *const config = (const void *)pkxyz_config_words;
static const pkxyz_reference *const path = (const void *)pkxyz_path_words;
static pkxyz_exchange_memory *const memory = (void *)pkxyz_memory_words;

static note_head head; /* of the next note */
static int64_t told;   /* by the last call */

static void send_what_may_be_sent(void)
{
    const pkxyz_driver_rules_outgoing *out = memory->driver[0].out;
    for (int32_t n = 0; n < memory->driver[0].outgoing; n++) {
        const can_frame frame = {out[n].data, out[n].can_id, out[n].flags, out[n].length};
        if (out[n].reason == 0)
            slcan_send(&frame);
    }
}

/* After each call: a status other than 0 ends it all at 0 V. */
static void require(int32_t status)
{
    if (status == 0)
        return;
    pkxyz_stop(config, memory, now.us, &told);
    send_what_may_be_sent();
    port_print("pkxyz: a call did not come to its end");
    port_exit(5);
}

static void note_call(int32_t call)
{
    head.t_us = now.us;
    head.told = told;
    head.call = call;
    note(&head, memory);
}

static void take(const can_frame *frame)
{
    const int32_t status =
        pkxyz_on_frame(config, memory, frame->can_id, frame->flags, frame->length, frame->data, now.us, &told);
    stopwatch_pause();
    require(status);
    send_what_may_be_sent(); /* of a start-up; else there is nothing */
}

/* One step of the start-up: a frame, or none for a while. 1 once periods may begin, -1 if it failed. */
static int64_t dialogue(const can_frame *frame)
{
    if (frame) {
        take(frame);
    } else {
        require(pkxyz_wait(config, memory, now.us, &told));
        send_what_may_be_sent();
    }
    note_call(frame ? PKXYZ_CALL_FRAME : PKXYZ_CALL_WAIT);
    require(pkxyz_come_up(memory, &told));
    note_call(PKXYZ_CALL_COME_UP);
    return told;
}

static int come_up(void)
{
    can_frame frame;
    int64_t up = 0, polled_us = now.us;
    require(pkxyz_start(config, memory, now.us, &told));
    send_what_may_be_sent();
    note_call(PKXYZ_CALL_START);
    while (up == 0) {
        const int came = receive_until(now.us + POLL_US, &frame);
        if (!came) {
            polled_us = now.us;
        } else if (now.us - polled_us > UNPOLLED_MOST_US) {
            polled_us = now.us;
            up = dialogue(0);
        }
        if (up >= 0)
            up = dialogue(came ? &frame : 0);
    }
    return up > 0;
}

/* A frame while periods run; 1 once this period's sample is in. */
static int taken(const can_frame *frame)
{
    stopwatch_go_on();
    take(frame);
    if (told > FRESH)
        note_call(PKXYZ_CALL_FRAME);
    return (told & FRESH) != 0;
}

static void computed(int32_t overrun)
{
    stopwatch_go_on();
    const uint32_t before = stopwatch();
    require(pkxyz_period(config, memory, path, pkxyz_path_words_count, overrun, &told));
    head.cycle_counts = stopwatch() - before;
    stopwatch_pause();
    if (told < 0)
        return;
    if (memory->cycle[0].mode == PKXYZ_MODE_FAULT)
        discard_unsent(); /* no voltage of before follows a fault decision */
    head.overrun = overrun;
    note_call(PKXYZ_CALL_PERIOD);
}

static void finished(int64_t heartbeat_until_us)
{
    stopwatch_go_on();
    const int32_t status = pkxyz_finish(config, memory, now.us, heartbeat_until_us, &told);
    stopwatch_pause();
    require(status);
    send_what_may_be_sent();
    stopwatch_go_on();
    require(pkxyz_prepare(config, memory)); /* what no voltage waits for */
    stopwatch_pause();
    head.period_counts = stopwatch();
    note_call(PKXYZ_CALL_FINISH);
}

/* The period that is due at a time; returns when the next one is. Periods that are past are skipped whole. */
static int64_t period(int64_t t_us)
{
    can_frame frame;
    int32_t overrun = 0;
    wait_until(t_us);
    if (!BUS_COUNTS_FRAMES) /* plain PDOs: what came too late must not be taken for this period's */
        while (receive_until(now.us, &frame))
            taken(&frame);
    if (now.us - t_us >= PKXYZ_PERIOD_US) {
        overrun = (int32_t)((now.us - t_us) / PKXYZ_PERIOD_US);
        t_us += (int64_t)overrun * PKXYZ_PERIOD_US;
    }
    memory->missed_ticks += now.unsent != 0;
    if (now.clearing >= 0)
        memory->clearing = now.clearing;
    stopwatch_start();
    const int32_t status = pkxyz_begin(config, memory, t_us, &told);
    stopwatch_pause();
    require(status);
    send_what_may_be_sent();
    if (told & SOMETHING_TO_SAY)
        note_call(PKXYZ_CALL_BEGIN);
    const int64_t deadline_us = t_us + BUS_SENSE_DEADLINE_US;
    while (receive_until(deadline_us, &frame))
        if (taken(&frame) || now.us > deadline_us)
            break;
    computed(overrun);
    spend(BUS_COMPUTE_US);
    finished(t_us + BUS_HEARTBEAT_DEADLINE_US);
    return t_us + PKXYZ_PERIOD_US;
}

int main(void)
{
    uart_open();
    notes_open();
    stopwatch_open();
    require(pkxyz_switch_on(memory));
    memory->outputs[0] = *(const pkxyz_outputs *)(const void *)pkxyz_outputs_words; /* as they were asked for */
    wait_until(0); /* for the time that it is */
    if (!come_up()) {
        wait_until(now.us); /* for the last notes to be taken */
        return 6;
    }
    for (int64_t t_us = now.us + PKXYZ_PERIOD_US;;)
        t_us = period(t_us);
}
