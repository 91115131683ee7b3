/* The fixed-rate loop: start the amplifier, then wait, exchange, compute, record. */
#ifndef LOOP_H
#define LOOP_H

#include "pkxyz.h"

/* Whatever happens, it leaves the combs at 0 V and the node pre-operational. Returns a PKXYZ_OUTCOME. */
int loop(pkxyz_shared *shared);

#endif
