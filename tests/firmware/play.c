/* Segments, exchanges and frames through the exported object, for a shared library on the host. */
#define main self_test_main
#include "main.c"
#undef main

int32_t play(const pkxyz_cycle_law *law, pkxyz_cycle_memory *memory, const pkxyz_reference *rows_of_path,
             int32_t path_count, const pkxyz_cycle_input *inputs, int32_t count, pkxyz_row *rows)
{
    for (int32_t n = 0; n < count; n++) {
        memory->input = inputs[n];
        if (pkxyz_cycle(law, memory, rows_of_path, path_count) != 0)
            return n + 1;
        rows[n] = memory->row;
    }
    return 0;
}

/* Calls of an exchange from switching on; a digest of what each left. */
int32_t converse(const pkxyz_exchange *settings, pkxyz_exchange_memory *memory, const pkxyz_reference *rows_of_path,
                 int32_t path_count, const pkxyz_calls_call *script, int32_t count, uint64_t *digests)
{
    int64_t told = 0;
    if (pkxyz_switch_on(memory) != 0)
        return 1;
    for (int32_t n = 0; n < count; n++) {
        if (called(settings, rows_of_path, path_count, &script[n], memory, &told) != 0)
            return n + 1;
        digests[n] = left_by(&script[n], memory, told, pkxyz_hash_begin);
    }
    return 0;
}

/* Frames through the gate, from switching on; a negative mode clears it. */
int32_t judge(const pkxyz_exchange *settings, pkxyz_exchange_memory *memory, const pkxyz_calls_call *frames,
              int32_t count, int32_t *reasons)
{
    int64_t told = 0;
    if (pkxyz_switch_on(memory) != 0)
        return 1;
    for (int32_t n = 0; n < count; n++) {
        if (frames[n].mode < 0)
            memory->gate[0].latched = 0;
        else if (called(settings, 0, 0, &frames[n], memory, &told) != 0)
            return n + 1;
        else
            reasons[n] = memory->driver[0].out[0].reason;
    }
    return 0;
}
