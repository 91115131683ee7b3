/* Exchanges from a file of the host, the whole controller call by call, on the emulated board: back go a digest of what
   each call left, and last the memory. */
#define main self_test_main
#include "main.c"
#undef main

#include "host_files.h"

void *memset(void *to, int value, size_t size); /* of the port: there need be no C library */

enum { ROWS_MOST = 4096, CALLS_MOST = 16384 };

static pkxyz_exchange settings;
static pkxyz_exchange_memory held;
static pkxyz_reference rows[ROWS_MOST];
static pkxyz_calls_call script[CALLS_MOST];
static uint64_t digests[CALLS_MOST];

int main(void)
{
    int32_t head[2]; /* rows of the path, calls */
    const uint32_t from = opened("exchanges", 9, TO_READ), to = opened("digests", 7, TO_WRITE);
    while (moved(SYS_READ, from, head, sizeof head)) {
        int64_t told = 0;
        if (head[0] > ROWS_MOST || head[1] > CALLS_MOST)
            return 4;
        if (!moved(SYS_READ, from, &settings, sizeof settings) || !moved(SYS_READ, from, rows, sizeof rows[0] * head[0])
            || !moved(SYS_READ, from, script, sizeof script[0] * head[1]))
            return 5;
        memset(&held, 0, sizeof held);
        if (pkxyz_switch_on(&held) != 0)
            return 6;
        for (int32_t n = 0; n < head[1]; n++) {
            if (called(&settings, rows, head[0], &script[n], &held, &told) != 0)
                return 6;
            digests[n] = left_by(&script[n], &held, told, pkxyz_hash_begin);
        }
        if (!moved(SYS_WRITE, to, digests, sizeof digests[0] * head[1]) || !moved(SYS_WRITE, to, &held, sizeof held))
            return 7;
    }
    closed(to);
    return 0;
}
