/* The path, in blocks that somebody samples ahead. Nothing here waits for one. */
#ifndef PATH_H
#define PATH_H

#include "pkxyz.h"

void path_begin(const pkxyz_shared_path *blocks, int32_t count);

/* Rows from which tick `at` of the path can be read. 0 if nobody has sampled them in time: *rows then stays what it
   was, and the stage is to be led down, for which it takes no path. */
int path_at(int64_t at, const pkxyz_reference **rows, int32_t *count);

#endif
