/* Time, as whoever owns it says. On a board of yours this is a timer, and the CAN controller's queues. */
#ifndef TIME_OWNER_H
#define TIME_OWNER_H

#include "slcan.h"

typedef struct {
    int64_t us;      /* never runs backwards */
    int32_t unsent;  /* frames that still wait to go out */
    int32_t clearing; /* -1: nothing is asked; else what pkxyz_exchange_memory.clearing is to be */
} time_told;

extern time_told now;

void wait_until(int64_t t_us);                      /* at once if that is past */
int receive_until(int64_t t_us, can_frame *frame); /* 1: a frame came, maybe one that waited; 0: it is t_us */
void spend(int64_t us);                             /* computing has taken so long */
void discard_unsent(void);

#endif
