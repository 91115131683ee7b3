/* The self-test's exchange once more on the emulated board: how long each period takes from its beginning to the end of
   what its drive frame did not wait for, frames and gate included, by the board's own counter. */
#define main self_test_main
#include "main.c"
#undef main

#include "host_files.h"

enum { PERIODS_MOST = 4096 };
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xe000e010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xe000e014)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xe000e018)

static uint32_t counts[PERIODS_MOST];

int main(void)
{
    pkxyz_exchange_memory *const memory = (void *)pkxyz_memory_words;
    int32_t periods = 0;
    int64_t told = 0;
    SYSTICK_RELOAD = 0xffffff;
    SYSTICK_CONTROL = 5; /* counts down with the processor's clock */
    if (pkxyz_switch_on(memory) != 0)
        return 1;
    for (int32_t n = 0; n < pkxyz_call_words_count && periods < PERIODS_MOST; n++) {
        if (calls[n].kind == PKXYZ_CALL_BEGIN)
            SYSTICK_VALUE = 0;
        uint32_t before = SYSTICK_VALUE;
        if (called(config, path, pkxyz_path_words_count, &calls[n], memory, &told) != 0)
            return 1;
        counts[periods] += (before - SYSTICK_VALUE) & 0xffffff;
        if (calls[n].kind == PKXYZ_CALL_COME_UP && told == 1)
            counts[periods] = 0; /* of the start-up */
        if (calls[n].kind == PKXYZ_CALL_PREPARE)
            periods++;
    }
    const uint32_t file = opened("counts", 6, TO_WRITE);
    const int failed = !moved(SYS_WRITE, file, counts, sizeof counts[0] * periods);
    closed(file);
    return failed;
}
