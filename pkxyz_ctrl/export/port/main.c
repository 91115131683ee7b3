/* The self-test: the sense frames of $ticks recorded ticks, and what must come of them, bit by bit.
   one_period() is all that a board does with the controller between its SYNC and its drive frame. */
#include "pkxyz.h"

extern const uint64_t pkxyz_law_words[], pkxyz_wire_words[], pkxyz_path_words[];
extern const uint64_t pkxyz_frame_words[], pkxyz_tried_words[];
extern const int32_t pkxyz_path_words_count, pkxyz_frame_words_count;
extern const uint8_t pkxyz_row_is_double[], pkxyz_memory_is_double[];
extern const uint8_t pkxyz_frame_is_double[], pkxyz_wire_memory_is_double[];
extern const uint64_t pkxyz_hash_begin, pkxyz_hash_prime, pkxyz_nan, pkxyz_digests[];

/* What the port gives: a line to the engineer, and the end. */
void port_print(const char *line);
void port_exit(int code);

static const pkxyz_cycle_law *const law = (const void *)pkxyz_law_words;
static const pkxyz_wire *const wire = (const void *)pkxyz_wire_words;
static const pkxyz_reference *const path = (const void *)pkxyz_path_words;
static const pkxyz_wire_frame *const frames = (const void *)pkxyz_frame_words;
static const pkxyz_wire_frame *const tried = (const void *)pkxyz_tried_words;
static pkxyz_cycle_memory memory; /* zeros: nothing known, 0 V */
static pkxyz_wire_memory wire_memory, doubtful;

/* From SYNC to drive frame. Each is sent if its reason is 0; a drive frame that may not be is 0 V by other means. */
static int32_t one_period(int32_t tick, const pkxyz_wire_frame *sensed, pkxyz_wire_frame *frame)
{
    frame->t_us = (int64_t)tick * PKXYZ_PERIOD_US;
    frame->data = tick % 240 + 1; /* the SYNC counter, one byte */
    frame->can_id = 0x080;
    frame->flags = wire->flags;
    frame->length = 1;
    frame->mode = memory.mode;
    frame->counter = tick & 0xff;
    int32_t status = pkxyz_judge(wire, &wire_memory, frame);
    status |= pkxyz_sync(wire, &wire_memory);
    status |= pkxyz_receive(wire, &wire_memory, sensed);
    status |= pkxyz_take(&wire_memory, &memory);
    status |= pkxyz_cycle(law, &memory, path, pkxyz_path_words_count);
    status |= pkxyz_drive(wire, &memory, frame);
    return status | pkxyz_judge(wire, &wire_memory, frame);
}

static uint64_t hashed(uint64_t state, const void *record, size_t size, const uint8_t *is_double)
{
    const uint64_t *words = record;
    for (size_t n = 0; n < size / 8; n++) {
        uint64_t word = words[n];
        if (is_double[n] && (word & 0x7fffffffffffffff) > 0x7ff0000000000000)
            word = pkxyz_nan;
        state = (state ^ word) * pkxyz_hash_prime;
    }
    return state;
}

static int self_test(void)
{
    uint64_t state = pkxyz_hash_begin;
    int32_t part = 0;
    pkxyz_wire_frame frame = {0}, other;
    memory.mode = $mode; /* the node is operational */
    if (pkxyz_begin(&wire_memory) != 0 || pkxyz_begin(&doubtful) != 0)
        return 1;
    for (int32_t tick = 0; tick < pkxyz_frame_words_count; tick++) {
        other = tried[tick]; /* another gate, which is asked about anything */
        if (one_period(tick, &frames[tick], &frame) != 0 || pkxyz_judge(wire, &doubtful, &other) != 0)
            return 1;
        if (tick % 2 && pkxyz_clear(&doubtful) != 0)
            return 1;
        state = hashed(state, &memory.row, sizeof memory.row, pkxyz_row_is_double);
        state = hashed(state, &frame, sizeof frame, pkxyz_frame_is_double);
        state = hashed(state, &other, sizeof other, pkxyz_frame_is_double);
        if ((tick + 1) % $every == 0 && state != pkxyz_digests[part++])
            return 1;
    }
    state = hashed(state, &memory, sizeof memory, pkxyz_memory_is_double);
    state = hashed(state, &wire_memory, sizeof wire_memory, pkxyz_wire_memory_is_double);
    return hashed(state, &doubtful, sizeof doubtful, pkxyz_wire_memory_is_double) != pkxyz_digests[part];
}

int main(void)
{
    int failed = self_test();
    port_print(failed ? "pkxyz: self-test FAILED: these are not the bits of the controller"
                      : "pkxyz: self-test passed, $ticks ticks, $last");
    port_exit(failed);
    return failed;
}
