/* When a tick begins: what it must not begin with is looked after here. */
#ifndef TICKS_H
#define TICKS_H

#include "pkxyz.h"

void ticks_begin(const pkxyz_shared_settings *settings, pkxyz_shared_state *state);

/* Returns at t_us, or at a later tick where that one is given up: woken so late that no answer could come in time, or
   too soon behind the end of the one before. 1: go on; 0: the end was asked for, and the stage is down. */
int ticks_wait_until(int64_t t_us);

/* What the tick that began at t_us computed is about to be sent: where time may stand still it is so early that the
   next is in time. */
void ticks_computed(int64_t t_us);

#endif
