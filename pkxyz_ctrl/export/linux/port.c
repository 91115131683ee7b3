#define _GNU_SOURCE
#include "port.h"

#include <poll.h>
#include <string.h>
#include <time.h>

#include "clock.h"
#include "ring.h"

enum { BUS_OFF = 0x40 }; /* class of an error frame (linux/can/error.h); the next one, of a restart, has another */

static const bus *under;
static pkxyz_shared_state *state;
static pkxyz_shared_port *counts;
static int64_t spin_us, last_us, sensed_ns; /* sensed: 0 where nothing is to be answered */
static int32_t heartbeat_id, sense_id, drive_id;

int port_open(const pkxyz_shared_settings *settings, pkxyz_shared_state *said, char *why, int size)
{
    state = said;
    counts = said->port;
    under = settings->interface == PKXYZ_INTERFACE_UNIX ? &unix_bus : &can_bus;
    spin_us = settings->sense_deadline_us / 2;
    heartbeat_id = settings->node_heartbeat_id;
    sense_id = settings->sense_id;
    drive_id = settings->drive_id;
    if (under->open(settings, why, size) != 0)
        return -1;
    port_look();
    return 0;
}

void port_send(const pkxyz_driver_rules_outgoing *out)
{
    frame sent = {.can_id = out->can_id, .flags = out->flags, .length = out->length};
    memcpy(sent.data, &out->data, sizeof out->data);
    const int refusal = under->send(&sent);
    const int64_t answered_ns = sensed_ns;
    sensed_ns = 0;
    counts->refuses = refusal != 0;
    if (refusal != 0) {
        counts->refusal = refusal;
        counts->refused++;
        return;
    }
    counts->sent++;
    if (answered_ns != 0 && out->can_id == drive_id)
        clock_count(state->answers, PKXYZ_HISTOGRAM_US, (clock_monotonic_ns() - answered_ns) / 1000);
    ring_frame(&sent, clock_now_us());
}

/* An answer that comes soon, as a sense frame does, is not delayed by a wake-up: it is looked for before it is slept. */
static int awaited(int64_t deadline_us, frame *taken)
{
    int64_t now_us = clock_now_us();
    const int64_t sleep_us = deadline_us < now_us + spin_us ? deadline_us : now_us + spin_us;
    int came;
    while ((came = under->take(taken)) == 0 && clock_now_us() < sleep_us)
        clock_relax();
    while (came == 0 && (now_us = clock_now_us()) < deadline_us) {
        const int64_t patience_us = under->patience_us(), left_us = deadline_us - now_us;
        const int64_t time_us = patience_us < left_us ? patience_us : left_us;
        const struct timespec time = {time_us / 1000000, time_us % 1000000 * 1000};
        struct pollfd looked = {under->descriptor(), POLLIN, 0};
        ppoll(&looked, 1, &time, 0);
        came = under->take(taken);
    }
    return came;
}

int port_receive(int64_t deadline_us, frame *taken)
{
    if (awaited(deadline_us, taken) != 1)
        return 0;
    if (taken->flags & FRAME_ERROR)
        counts->is_bus_off = (taken->can_id & BUS_OFF) != 0;
    const int64_t sent_us = (taken->sent_ns - clock_begun_ns()) / 1000;
    if (sent_us > last_us) /* it never runs backwards */
        last_us = sent_us;
    if (taken->can_id == sense_id)
        sensed_ns = clock_monotonic_ns();
    if (taken->can_id == heartbeat_id)
        state->heartbeat_us = last_us;
    ring_frame(taken, last_us);
    return 1;
}

void port_look(void)
{
    under->look();
    counts->others = under->others();
    counts->dropped = under->dropped();
}

void port_discard(void)
{
    under->discard();
}

void port_close(void)
{
    counts->dropped = under->dropped();
    under->close();
}
