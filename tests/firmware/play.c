/* A segment of ticks through the exported object; for a shared library on the host. */
#include "pkxyz.h"

int32_t play(const pkxyz_cycle_law *law, pkxyz_cycle_memory *memory, const pkxyz_reference *path, int32_t path_count,
             const pkxyz_cycle_input *inputs, int32_t count, pkxyz_row *rows)
{
    for (int32_t n = 0; n < count; n++) {
        memory->input = inputs[n];
        if (pkxyz_cycle(law, memory, path, path_count) != 0)
            return n + 1;
        rows[n] = memory->row;
    }
    return 0;
}

/* Frames through the exported gate; a negative mode clears it. */
int32_t judge(const pkxyz_wire *wire, pkxyz_wire_memory *memory, pkxyz_wire_frame *frames, int32_t count)
{
    for (int32_t n = 0; n < count; n++)
        if ((frames[n].mode < 0 ? pkxyz_clear(memory) : pkxyz_judge(wire, memory, &frames[n])) != 0)
            return n + 1;
    return 0;
}
