/* Segments from a file of the host through the exported object, on the emulated board: back go a hash of each tick's
   row and the time that the call took by the board's own counter, and last the memory. */
#include "host_files.h"
#include "pkxyz.h"

void *memset(void *to, int value, size_t size); /* of the port: there need be no C library */

enum { PATH_MOST = 2048, TICKS_MOST = 2048 };
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xe000e010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xe000e014)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xe000e018)

extern const uint8_t pkxyz_row_is_double[];
extern const uint64_t pkxyz_hash_begin, pkxyz_hash_prime, pkxyz_nan;
void port_print(const char *line);
void port_exit(int code);

/* Of the records of every law; of a planner's, with what it needs of what stands behind. */
#define AT_LEAST(least, size) ((size) > (least) ? (size) : (least))
#define LAW_BYTES AT_LEAST(sizeof(pkxyz_cycle_law), PKXYZ_CONFIG_BYTES - offsetof(pkxyz_exchange, law))
#define MEMORY_BYTES AT_LEAST(sizeof(pkxyz_cycle_memory), PKXYZ_MEMORY_BYTES - offsetof(pkxyz_exchange_memory, cycle))
static uint64_t law_words[LAW_BYTES / 8], memory_words[MEMORY_BYTES / 8];
static pkxyz_reference path[PATH_MOST];
static pkxyz_cycle_input inputs[TICKS_MOST];
static struct { uint64_t hash; uint32_t counts, status; } results[TICKS_MOST];

static uint64_t hashed(const void *record, size_t size)
{
    const uint64_t *words = record;
    uint64_t state = pkxyz_hash_begin;
    for (size_t n = 0; n < size / 8; n++) {
        uint64_t word = words[n];
        if (pkxyz_row_is_double[n] && (word & 0x7fffffffffffffff) > 0x7ff0000000000000)
            word = pkxyz_nan;
        state = (state ^ word) * pkxyz_hash_prime;
    }
    return state;
}

int main(void)
{
    const pkxyz_cycle_law *const law = (const void *)law_words;
    pkxyz_cycle_memory *const memory = (void *)memory_words;
    int32_t head[4]; /* rows of the path, ticks, and 1 where a memory of zeros begins, in the mode that follows */
    uint32_t from = opened("segments", 8, TO_READ), to = opened("results", 7, TO_WRITE);
    SYSTICK_RELOAD = 0xffffff;
    SYSTICK_CONTROL = 5; /* counts down with the processor's clock */
    while (moved(SYS_READ, from, head, sizeof head)) {
        if (head[0] > PATH_MOST || head[1] > TICKS_MOST)
            return 4;
        if (head[2]) {
            memset(memory, 0, MEMORY_BYTES);
            memory->mode = head[3];
        }
        if (!moved(SYS_READ, from, law_words, LAW_BYTES) || !moved(SYS_READ, from, path, sizeof path[0] * head[0])
            || !moved(SYS_READ, from, inputs, sizeof inputs[0] * head[1]))
            return 5;
        for (int32_t n = 0; n < head[1]; n++) {
            memory->input = inputs[n];
            SYSTICK_VALUE = 0;
            uint32_t begin = SYSTICK_VALUE;
            results[n].status = pkxyz_cycle(law, memory, path, head[0]);
            results[n].counts = (begin - SYSTICK_VALUE) & 0xffffff;
            results[n].hash = hashed(&memory->row, sizeof memory->row);
        }
        if (!moved(SYS_WRITE, to, results, sizeof results[0] * head[1]) || !moved(SYS_WRITE, to, memory, MEMORY_BYTES))
            return 6;
    }
    closed(to);
    return 0;
}
