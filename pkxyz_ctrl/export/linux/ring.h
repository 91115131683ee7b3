/* Rows and frames on their way to whoever records them. Nothing here waits: a tick for which there is no room is lost
   whole, its frames with it, and counted. */
#ifndef RING_H
#define RING_H

#include "frame.h"
#include "pkxyz.h"

void ring_begin(pkxyz_shared_ring *ring, uint8_t *bytes, int64_t size);

/* A frame that was sent or came at t_us. It is handed over with the row of its tick, or by ring_hand_over. */
void ring_frame(const frame *noted, int64_t t_us);
void ring_row(const pkxyz_row *row);
void ring_hand_over(void);

/* The last entry, with which the reader knows that all came; for this one, once the loop is over, there is time. */
void ring_end(void);

#endif
