#include "controller.h"

#include <string.h>

#include "port.h"
#include "told.h"

enum { WARM_UP_US = 1000 };
enum { FRESH = 1, EMERGENCY = 2, START_UP = 4 };                      /* what pkxyz_on_frame tells */
enum { BLOCKED = 256, RESTARTED = 512, NOT_RESTARTED = 1024, RARE = BLOCKED | RESTARTED | NOT_RESTARTED };

static pkxyz_exchange *config;
static pkxyz_exchange_memory *memory;
static pkxyz_planned_exchange_memory warm[1];
static uint32_t closed_modes;
static int failed;

void controller_begin(pkxyz_shared *shared)
{
    config = shared->config->own;
    memory = shared->memory->own;
    closed_modes = (uint32_t)shared->settings->loop_closed;
}

/* A copy of the memory; of what a plan is made in, which is much, only where there is one. */
static pkxyz_exchange_memory *copied(void)
{
    memcpy(warm, memory, config->law->tick.kind == PKXYZ_PREDICTIVE ? sizeof *warm : sizeof *warm->own);
    return warm->own;
}

void controller_warm_up(void)
{
    static const pkxyz_reference still;
    pkxyz_exchange_memory *copy = copied();
    int64_t told;
    for (int32_t n = 1; n <= 3; n++) {
        pkxyz_begin(config, copy, n * WARM_UP_US, &told);
        pkxyz_on_frame(config, copy, config->driver->sense->pdo->cob_id, 0, 8, 0, n * WARM_UP_US, &told);
        pkxyz_period(config, copy, &still, 1, 0, &told);
        pkxyz_finish(config, copy, n * WARM_UP_US, 0, &told);
        pkxyz_prepare(config, copy);
    }
}

void controller_rehearse(const pkxyz_reference *rows, int32_t count)
{
    int64_t told;
    pkxyz_period(config, copied(), rows, count, 0, &told);
}

int controller_mode(void)
{
    return memory->cycle->mode;
}

int controller_is_closed(void)
{
    return closed_modes >> memory->cycle->mode & 1;
}

int controller_status(void)
{
    return failed;
}

void controller_request(int event)
{
    memory->event = event;
}

static void note(int32_t status)
{
    if (failed == 0)
        failed = status;
}

void controller_clear(void)
{
    note(pkxyz_ask_to_clear(memory));
}

void controller_change_law(const pkxyz_law_change_change *change)
{
    note(pkxyz_take_over(config->law, memory->cycle, change));
}

/* Sends what the gate let out, and nothing else; what it held back somebody puts into words. */
static void send_out(int32_t status, int64_t told, int64_t t_us)
{
    const pkxyz_driver_rules_driver_memory *driver = memory->driver;
    note(status);
    for (int32_t n = 0; status == 0 && n < driver->outgoing; n++)
        if (driver->out[n].reason == 0)
            port_send(&driver->out[n]);
    if (told & RARE)
        told_frames(told, t_us);
}

void controller_start(int64_t t_us)
{
    int64_t told = 0;
    const int32_t status = pkxyz_start(config, memory, t_us, &told);
    send_out(status, told, t_us);
}

int controller_come_up(const frame *came, int64_t t_us)
{
    int64_t told = 0;
    if (came) {
        controller_take(came, t_us);
    } else {
        const int32_t status = pkxyz_wait(config, memory, t_us, &told);
        send_out(status, told, t_us);
    }
    note(pkxyz_come_up(memory, &told));
    return failed ? -1 : (int)told;
}

void controller_sync(int64_t t_us)
{
    int64_t told = 0;
    const int32_t status = pkxyz_begin(config, memory, t_us, &told);
    send_out(status, told, t_us);
}

int controller_take(const frame *came, int64_t t_us)
{
    int64_t told = 0, word;
    memcpy(&word, came->data, sizeof word);
    const int32_t status = pkxyz_on_frame(config, memory, came->can_id, came->flags, came->length, word, t_us, &told);
    note(status);
    if (told & EMERGENCY)
        told_emergency(came, told, t_us);
    if (told & START_UP) {
        int64_t held = 0;
        for (int32_t n = 0; n < memory->driver->outgoing; n++)
            if (memory->driver->out[n].reason != 0)
                held = BLOCKED;
        send_out(status, held ? held | memory->driver->outgoing : 0, t_us);
    }
    return told & FRESH;
}

void controller_compute(const pkxyz_reference *rows, int32_t count, int32_t overrun)
{
    int64_t left = -1;
    note(pkxyz_period(config, memory, rows, count, overrun, &left));
    if (left >= 0 && memory->cycle->mode == PKXYZ_MODE_FAULT) {
        port_discard(); /* no voltage of before follows a fault decision */
        told_fault(memory->begun_us);
    }
}

void controller_finish(int64_t t_us, int64_t heartbeat_until_us)
{
    int64_t told = 0;
    const int32_t status = pkxyz_finish(config, memory, t_us, heartbeat_until_us, &told);
    send_out(status, told, t_us);
    note(pkxyz_prepare(config, memory)); /* what no voltage waits for */
}

void controller_stop(int64_t t_us)
{
    int64_t told = 0;
    const int32_t status = pkxyz_stop(config, memory, t_us, &told);
    send_out(status, told, t_us);
}
