#include "told.h"

#include <stdatomic.h>
#include <string.h>

static pkxyz_shared *shared;

void told_begin(pkxyz_shared *with)
{
    shared = with;
}

static void tell(int32_t kind, const frame *came, int64_t told, int64_t t_us)
{
    pkxyz_shared_events_ring *events = shared->events;
    const int64_t head = events->head;
    if (head - atomic_load_explicit((_Atomic int64_t *)&events->tail, memory_order_acquire) >= PKXYZ_EVENTS) {
        events->lost++;
        return;
    }
    pkxyz_shared_event *event = &events->event[head % PKXYZ_EVENTS];
    event->kind = kind;
    event->told = told;
    event->t_us = t_us;
    if (came) {
        event->frame->can_id = came->can_id;
        event->frame->flags = came->flags;
        event->frame->length = came->length;
        memcpy(&event->frame->data, came->data, sizeof event->frame->data);
    }
    *event->port = *shared->state->port;
    *event->memory = *shared->memory->own;
    atomic_store_explicit((_Atomic int64_t *)&events->head, head + 1, memory_order_release);
}

void told_frames(int64_t told, int64_t t_us)
{
    tell(PKXYZ_TOLD_FRAMES, 0, told, t_us);
}

void told_emergency(const frame *came, int64_t told, int64_t t_us)
{
    tell(PKXYZ_TOLD_EMERGENCY, came, told, t_us);
}

void told_fault(int64_t t_us)
{
    tell(PKXYZ_TOLD_FAULT, 0, 0, t_us);
}
