/* A stage in operation, beside whose loop somebody decides: his orders and set-points are taken between two ticks, and
   what the tick left is put where he sees it. With hardware nothing here waits for him. */
#ifndef ORDERS_H
#define ORDERS_H

#include "pkxyz.h"

/* wake: an eventfd on which he waits for the end of a tick; -1: he doesn't. */
void orders_begin(pkxyz_shared *shared, int wake);

/* Where all is simulated, time stands still while he has not looked at the tick before: for so long as for an answer of
   the amplifier, and not if he did not look the last time. */
void orders_await(void);

/* What was ordered since, if anything, and the rows of the set-points for this tick. A sheet that differs in a row which
   the law has seen is refused, and the one before goes on: so a set-point never jumps. Where the rows end while it moves,
   or where he has looked at nothing for too long, the stage is led down. */
void orders_take(const pkxyz_reference **rows, int32_t *count);

/* A tick is over: a snapshot of what it left, and word of it. */
void orders_leave(void);

#endif
