/* One CAN frame, as the loop carries it. */
#ifndef FRAME_H
#define FRAME_H

#include <stdint.h>

enum { FRAME_FD = 1, FRAME_FAST = 2, FRAME_REMOTE = 4, FRAME_EXTENDED = 8, FRAME_ERROR = 16 };
enum { FRAME_BYTES = 64 };

typedef struct {
    int64_t sent_ns; /* CLOCK_MONOTONIC, when it was on the bus */
    int32_t can_id;
    int32_t flags;
    int32_t length; /* of a remote frame: what it asks for */
    uint8_t data[FRAME_BYTES];
} frame;

#endif
