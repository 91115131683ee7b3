/* Frames as lines of text, as slcan has them: python-can's `slcan`, CAN FD included. */
#ifndef SLCAN_H
#define SLCAN_H

#include <stdint.h>

enum { FRAME_FD = 1, FRAME_FAST = 2, FRAME_REMOTE = 4, FRAME_EXTENDED = 8 };

typedef struct {
    int64_t data; /* the first eight bytes, the first lowest: nothing that matters is longer */
    int32_t can_id;
    int32_t flags;  /* FRAME_ */
    int32_t length; /* bytes, up to 64 */
} can_frame;

void slcan_send(const can_frame *frame);
void slcan_receive(can_frame *frame); /* the next one; waits for it */

#endif
