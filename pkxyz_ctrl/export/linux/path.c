#include "path.h"

#include <stdatomic.h>

static const pkxyz_shared_path *blocks;
static int32_t blocks_count;

void path_begin(const pkxyz_shared_path *first, int32_t count)
{
    blocks = first;
    blocks_count = count;
}

int path_at(int64_t at, const pkxyz_reference **rows, int32_t *count)
{
    const int64_t number = at / PKXYZ_BLOCK_ROWS;
    const pkxyz_shared_path *block = &blocks[number % blocks_count];
    if (atomic_load_explicit((const _Atomic int64_t *)&block->number, memory_order_acquire) != number)
        return 0;
    *rows = block->rows;
    *count = sizeof block->rows / sizeof *block->rows;
    return 1;
}
