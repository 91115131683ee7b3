/* Rows and frames on their way to whoever records them. Nothing here waits: a tick for which there is no room is lost
   whole, its frames with it, and counted. */
#ifndef RING_H
#define RING_H

#include "frame.h"
#include "pkxyz.h"

/* Kinds of entries: a frame's is twice its flags. A frame: kind, length, time in us (8 bytes), identifier (4), data.
   A row: kind, then the row. The end: kind, then how many bytes were lost (8). All little-endian, nothing between. */
enum { RING_ROW = 1, RING_END = 3, RING_FRAME_HEAD = 14 };

void ring_begin(pkxyz_shared_ring *ring, uint8_t *bytes, int64_t size);

/* A frame that was sent or came at t_us. It is handed over with the row of its tick, or by ring_hand_over. */
void ring_frame(const frame *noted, int64_t t_us);
void ring_row(const pkxyz_row *row);
void ring_hand_over(void);

/* The last entry, with which the reader knows that all came; for this one, once the loop is over, there is time. */
void ring_end(void);

#endif
