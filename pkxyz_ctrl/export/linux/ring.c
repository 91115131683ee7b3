#define _GNU_SOURCE
#include "ring.h"

#include <stdatomic.h>
#include <string.h>
#include <time.h>

enum { PATIENCE_MS = 2000 };

static pkxyz_shared_ring *ring;
static uint8_t *room;
static int64_t size, written, tick_bytes;
static int is_lost; /* what belongs to this tick, from the entry on for which there was no room */

void ring_begin(pkxyz_shared_ring *shared, uint8_t *bytes, int64_t bytes_size)
{
    ring = shared;
    room = bytes;
    size = bytes_size;
    written = shared->head;
}

static int64_t tail(void)
{
    return atomic_load_explicit((_Atomic int64_t *)&ring->tail, memory_order_acquire);
}

static void put(const void *bytes, int64_t count)
{
    tick_bytes += count;
    if (is_lost || written + count - tail() > size) {
        is_lost = 1;
        return;
    }
    const int64_t at = written % size, before_end = size - at < count ? size - at : count;
    memcpy(room + at, bytes, (size_t)before_end);
    memcpy(room, (const uint8_t *)bytes + before_end, (size_t)(count - before_end));
    written += count;
}

void ring_hand_over(void)
{
    if (is_lost) {
        written = ring->head;
        ring->lost_bytes += tick_bytes;
    }
    atomic_store_explicit((_Atomic int64_t *)&ring->head, written, memory_order_release);
    tick_bytes = is_lost = 0;
}

void ring_frame(const frame *noted, int64_t t_us)
{
    uint8_t entry[RING_FRAME_HEAD + FRAME_BYTES];
    entry[0] = (uint8_t)(noted->flags << 1);
    entry[1] = (uint8_t)noted->length;
    memcpy(entry + 2, &t_us, 8);
    memcpy(entry + 10, &noted->can_id, 4);
    memcpy(entry + RING_FRAME_HEAD, noted->data, (size_t)noted->length);
    put(entry, RING_FRAME_HEAD + noted->length);
}

void ring_row(const pkxyz_row *row)
{
    const uint8_t kind = RING_ROW;
    put(&kind, 1);
    put(row, sizeof *row);
    ring->lost_rows += is_lost;
    ring_hand_over();
}

void ring_end(void)
{
    const uint8_t kind = RING_END;
    const struct timespec moment = {0, 1000000};
    ring_hand_over();
    for (int n = 0; n < PATIENCE_MS && written + 9 - tail() > size; n++)
        nanosleep(&moment, 0);
    put(&kind, 1);
    put(&ring->lost_bytes, 8);
    ring_hand_over();
}
