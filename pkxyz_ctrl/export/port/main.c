/* The self-test: the inputs of $ticks recorded ticks, and what must come of them, bit by bit.
   one_period() is all that a board does with the controller between its SYNC and its drive frame. */
#include "pkxyz.h"

extern const uint64_t pkxyz_law_words[], pkxyz_path_words[], pkxyz_input_words[];
extern const int32_t pkxyz_path_words_count, pkxyz_input_words_count;
extern const uint8_t pkxyz_row_is_double[], pkxyz_memory_is_double[];
extern const uint64_t pkxyz_hash_begin, pkxyz_hash_prime, pkxyz_nan, pkxyz_digests[];

/* What the port gives: a line to the engineer, and the end. */
void port_print(const char *line);
void port_exit(int code);

static const pkxyz_cycle_law *const law = (const void *)pkxyz_law_words;
static const pkxyz_reference *const path = (const void *)pkxyz_path_words;
static const pkxyz_cycle_input *const inputs = (const void *)pkxyz_input_words;
static pkxyz_cycle_memory memory; /* zeros: nothing known, 0 V */

static int32_t one_period(const pkxyz_cycle_input *seen, int32_t drive_count[3])
{
    memory.input = *seen;
    int32_t status = pkxyz_cycle(law, &memory, path, pkxyz_path_words_count);
    for (int i = 0; i < 3; i++)
        drive_count[i] = status == 0 ? memory.row.drive_count[i] : 0;
    return status;
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
    int32_t drive_count[3], part = 0;
    memory.mode = $mode; /* the node is operational */
    for (int32_t tick = 0; tick < pkxyz_input_words_count; tick++) {
        if (one_period(&inputs[tick], drive_count) != 0)
            return 1;
        state = hashed(state, &memory.row, sizeof memory.row, pkxyz_row_is_double);
        if ((tick + 1) % $every == 0 && state != pkxyz_digests[part++])
            return 1;
    }
    return hashed(state, &memory, sizeof memory, pkxyz_memory_is_double) != pkxyz_digests[part];
}

int main(void)
{
    int failed = self_test();
    port_print(failed ? "pkxyz: self-test FAILED: these are not the bits of the controller"
                      : "pkxyz: self-test passed, $ticks ticks, $last");
    port_exit(failed);
    return failed;
}
