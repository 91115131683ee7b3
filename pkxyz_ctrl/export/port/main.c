/* The self-test: a recorded exchange of $ticks periods, its start-up before it, and what must come of it, bit by bit.
   called() has every call that a board makes of the controller. */
#include "pkxyz.h"

extern const uint64_t pkxyz_config_words[], pkxyz_path_words[], pkxyz_call_words[], pkxyz_tried_words[];
extern uint64_t pkxyz_memory_words[], pkxyz_doubtful_words[]; /* zeros: nothing known, 0 V */
extern const int32_t pkxyz_path_words_count, pkxyz_call_words_count;
extern const uint8_t pkxyz_row_is_double[], pkxyz_memory_is_double[];
extern const uint64_t pkxyz_hash_begin, pkxyz_hash_prime, pkxyz_nan, pkxyz_digests[];

/* What the port gives: a line to the engineer, and the end. */
void port_print(const char *line);
void port_exit(int code);

static const pkxyz_exchange *const config = (const void *)pkxyz_config_words;
static const pkxyz_reference *const path = (const void *)pkxyz_path_words;
static const pkxyz_calls_call *const calls = (const void *)pkxyz_call_words;
static const pkxyz_calls_call *const tried = (const void *)pkxyz_tried_words;

static int32_t called(const pkxyz_exchange *config, const pkxyz_reference *path, int32_t rows,
                      const pkxyz_calls_call *call, pkxyz_exchange_memory *memory, int64_t *told)
{
    pkxyz_driver_rules_outgoing *out = memory->driver[0].out;
    const int64_t t_us = call->t_us;
    switch (call->kind) {
    case PKXYZ_CALL_START:
        return pkxyz_start(config, memory, t_us, told);
    case PKXYZ_CALL_WAIT:
        return pkxyz_wait(config, memory, t_us, told);
    case PKXYZ_CALL_COME_UP:
        return pkxyz_come_up(memory, told);
    case PKXYZ_CALL_BEGIN:
        return pkxyz_begin(config, memory, t_us, told);
    case PKXYZ_CALL_FRAME:
        return pkxyz_on_frame(config, memory, call->can_id, call->flags, call->length, call->data, t_us, told);
    case PKXYZ_CALL_PERIOD:
        return pkxyz_period(config, memory, path, rows, (int32_t)call->data, told);
    case PKXYZ_CALL_FINISH:
        return pkxyz_finish(config, memory, t_us, call->data, told);
    case PKXYZ_CALL_STOP:
        return pkxyz_stop(config, memory, t_us, told);
    case PKXYZ_CALL_JUDGE:
        out->data = call->data;
        out->can_id = call->can_id;
        out->flags = call->flags;
        out->length = call->length;
        out->reason = 0;
        memory->driver[0].outgoing = 1;
        memory->cycle[0].mode = call->mode;
        return pkxyz_judge(config, memory, 0, t_us, told);
    case PKXYZ_CALL_REQUEST:
        memory->event = (int32_t)call->data;
        break;
    case PKXYZ_CALL_CLEAR:
        memory->clearing = (int32_t)call->data;
        break;
    case PKXYZ_CALL_PREPARE:
        *told = 0;
        return pkxyz_prepare(config, memory);
    default:
        return 1;
    }
    *told = 0;
    return 0;
}

static uint64_t hashed(uint64_t state, const void *record, size_t size, const uint8_t *is_double)
{
    const uint64_t *words = record;
    for (size_t n = 0; n < size / 8; n++) {
        uint64_t word = words[n];
        if (is_double && is_double[n] && (word & 0x7fffffffffffffff) > 0x7ff0000000000000)
            word = pkxyz_nan;
        state = (state ^ word) * pkxyz_hash_prime;
    }
    return state;
}

/* What a call left: what it told, and the row of a period or frames, each with the gate's reason. */
static uint64_t left_by(const pkxyz_calls_call *call, pkxyz_exchange_memory *memory, int64_t told, uint64_t state)
{
    state = hashed(state, &told, sizeof told, 0);
    if (call->kind == PKXYZ_CALL_COME_UP || call->kind >= PKXYZ_CALL_REQUEST)
        return state;
    if (call->kind == PKXYZ_CALL_PERIOD)
        return hashed(state, &memory->cycle[0].row, sizeof memory->cycle[0].row, pkxyz_row_is_double);
    return hashed(state, memory->driver[0].out, sizeof memory->driver[0].out[0] * memory->driver[0].outgoing, 0);
}

static int self_test(pkxyz_exchange_memory *memory, pkxyz_exchange_memory *doubtful)
{
    uint64_t state = pkxyz_hash_begin;
    int64_t told = 0;
    int32_t part = 0, periods = 0;
    if (pkxyz_switch_on(memory) != 0 || pkxyz_switch_on(doubtful) != 0)
        return 1;
    for (int32_t n = 0; n < pkxyz_call_words_count; n++) {
        if (called(config, path, pkxyz_path_words_count, &calls[n], memory, &told) != 0)
            return 1;
        state = left_by(&calls[n], memory, told, state);
        if (calls[n].kind != PKXYZ_CALL_PERIOD)
            continue;
        if (called(config, path, 0, &tried[periods], doubtful, &told) != 0) /* another gate, which is asked about anything */
            return 1;
        state = left_by(&tried[periods], doubtful, told, state);
        if (periods++ % 2)
            doubtful->gate[0].latched = 0;
        if (periods % $every == 0 && state != pkxyz_digests[part++])
            return 1;
    }
    state = hashed(state, memory, PKXYZ_MEMORY_BYTES, pkxyz_memory_is_double);
    return hashed(state, doubtful, PKXYZ_MEMORY_BYTES, pkxyz_memory_is_double) != pkxyz_digests[part];
}

int main(void)
{
    int failed = self_test((void *)pkxyz_memory_words, (void *)pkxyz_doubtful_words);
    port_print(failed ? "pkxyz: self-test FAILED: these are not the bits of the controller"
                      : "pkxyz: self-test passed, $ticks periods, $last");
    port_exit(failed);
    return failed;
}
