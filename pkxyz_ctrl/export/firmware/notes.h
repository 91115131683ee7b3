/* What the record and its words are made of, told through the debugger: the memory as a call has left it. A board of
   yours sends its rows by whatever it has. */
#ifndef NOTES_H
#define NOTES_H

#include "pkxyz.h"

typedef struct {
    int64_t t_us;
    int64_t told;
    int32_t call;           /* PKXYZ_CALL_ */
    int32_t overrun;        /* periods skipped before this one */
    uint32_t cycle_counts;  /* of the board's counter in pkxyz_period, and in all calls of this period; 0 before */
    uint32_t period_counts;
} note_head;

void notes_open(void);
void note(const note_head *head, const pkxyz_exchange_memory *memory);
int32_t notes_count(void); /* since they were last taken */
void notes_taken(void);

#endif
